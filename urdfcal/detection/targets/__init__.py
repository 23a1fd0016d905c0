"""Boards, tags and grids of dots in images."""
