"""Local reconstructors behind one contract."""
