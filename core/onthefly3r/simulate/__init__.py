"""Synthetic surveys with truth, and the oracle backbone."""
