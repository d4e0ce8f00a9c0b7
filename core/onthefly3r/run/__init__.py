"""A run as a folder: who owns it, what it recorded, and how it is worked on."""
