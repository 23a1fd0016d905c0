"""Cameras: projection and its derivatives, rigs of several cameras, and calibration from pictures of a board."""
