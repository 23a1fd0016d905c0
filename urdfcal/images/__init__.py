"""Image files, image sequences and videos as arrays."""
