"""Descriptors, retrieval and dynamic subsets."""
