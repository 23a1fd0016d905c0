"""Joint models, one file for each: what lies between a joint reading and the joint's true value (METHOD 7)."""

from urdfcal.estimation.joint_models.base import JointModel, Readings
from urdfcal.estimation.joint_models.time_offset import TimeOffsets
from urdfcal.estimation.joint_models.zero_offset import ZeroOffsets

JOINT_MODELS: tuple[type[JointModel], ...] = (ZeroOffsets, TimeOffsets)
"""Every joint model there is. A new one is a file of its own and a name here."""

__all__ = ["JOINT_MODELS", "JointModel", "Readings"]
