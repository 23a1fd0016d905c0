"""A calibration in the formats of its consumers: one module a format, each returning files by name."""
