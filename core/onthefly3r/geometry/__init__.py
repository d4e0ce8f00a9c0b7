"""Transforms, cameras and frames: plain numpy, no other layer below."""
