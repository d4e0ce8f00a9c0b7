"""The pose graph: what submaps measured of each other, and the poses that agree best."""
