"""The experiments of the paper as commands: data sets, strategies on one backbone, tables beside its numbers."""
