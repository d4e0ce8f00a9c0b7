"""The online loop: images in, a validated and drift-free map out."""
