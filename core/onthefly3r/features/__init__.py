"""Local features of photographs, and matches between them."""
