"""URDF files: found, read, and rewritten with nothing but ``<origin>`` values changed."""
