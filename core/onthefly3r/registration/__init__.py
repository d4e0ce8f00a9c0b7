"""Alignment, validation and pruning of local models."""
