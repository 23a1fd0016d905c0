"""Kinds of measurement, one file for each: what was seen or touched, and how it follows from a state (METHOD 7)."""

from urdfcal.estimation.measurements.base import Measurement
from urdfcal.estimation.measurements.pixels import Detections
from urdfcal.estimation.measurements.points import Points

MEASUREMENTS: tuple[type[Measurement], ...] = (Detections, Points)
"""Every kind of measurement there is. A new one is a file of its own and a name here."""

__all__ = ["MEASUREMENTS", "Detections", "Measurement", "Points"]
