"""Which poses to measure next, and what they bring."""
