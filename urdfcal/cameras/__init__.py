"""Cameras: projection and its derivatives, rigs of several cameras, and calibration from images of a board."""
