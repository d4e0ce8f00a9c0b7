"""Bundle adjustment: cameras, points and intrinsics in one least squares."""
