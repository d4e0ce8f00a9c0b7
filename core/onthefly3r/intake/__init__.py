"""From files to shots and working images."""
