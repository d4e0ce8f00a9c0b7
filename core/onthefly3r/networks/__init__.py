"""Weights and devices of neural networks, shared by backbones and retrieval descriptors."""
