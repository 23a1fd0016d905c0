"""Detect small bright spots in one camera's images and locate their centres."""
