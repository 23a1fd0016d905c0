"""What the cameras see: projection, triangulation, and the files that describe cameras."""
