"""Check a session for wrong units, swapped names and stuck sensors."""
