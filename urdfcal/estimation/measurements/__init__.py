"""Kinds of measurement, one file for each: what was seen or touched, and how it follows from a state (METHOD 7)."""

from urdfcal.estimation.measurements.base import Measurement
from urdfcal.estimation.measurements.contacts import Contacts
from urdfcal.estimation.measurements.distances import Distances
from urdfcal.estimation.measurements.pixels import Detections
from urdfcal.estimation.measurements.planes import Planes
from urdfcal.estimation.measurements.points import Points
from urdfcal.estimation.measurements.poses import Poses

MEASUREMENTS: tuple[type[Measurement], ...] = (Detections, Points, Poses, Contacts, Planes, Distances)
"""Every kind of measurement there is. A new one is a file of its own and a name here."""

__all__ = ["MEASUREMENTS", "Contacts", "Detections", "Distances", "Measurement", "Planes", "Points", "Poses"]
