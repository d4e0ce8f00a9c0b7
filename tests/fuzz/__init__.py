"""Fuzzers of everything that reads files others made; `python -m fuzz --help` (with tests/ and core/ on PYTHONPATH)."""
