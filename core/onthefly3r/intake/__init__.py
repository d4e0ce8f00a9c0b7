"""From a folder of photographs to shots (header pass) and working images (pixels)."""
