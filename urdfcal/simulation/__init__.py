"""Simulated sessions of a robot whose true geometry is known."""
