"""The URDF file: found, read, and rewritten in place with nothing but ``<origin>`` values changed."""
