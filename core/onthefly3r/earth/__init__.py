"""Where things are on the Earth: positions, attitude, level, georeference."""
