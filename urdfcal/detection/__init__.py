"""Detect LEDs in a session's images."""
