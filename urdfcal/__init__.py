"""urdfcal: make the URDF match the arm, with two cameras and an LED.

    session = urdfcal.read_session("session/")
    calibration = urdfcal.calibrate(session)
    model = calibration.apply(pin.buildModelFromUrdf("robot.urdf"))

A session can be built in memory, too: a ``Setup`` of ``Chain``, ``Led``s and a ``Rig`` of ``Camera``s, to which a
``Recorder`` adds poses and detections one by one.

Names are loaded when they are first used: ``import urdfcal`` and ``urdfcal --help`` wait for nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from urdfcal.cameras.camera import Camera as Camera
    from urdfcal.cameras.rig import Rig as Rig
    from urdfcal.errors import UrdfcalError as UrdfcalError
    from urdfcal.estimation.measurements import Contacts as Contacts
    from urdfcal.estimation.measurements import Detections as Detections
    from urdfcal.estimation.measurements import Distances as Distances
    from urdfcal.estimation.measurements import Planes as Planes
    from urdfcal.estimation.measurements import Points as Points
    from urdfcal.estimation.measurements import Poses as Poses
    from urdfcal.io.folder import read_rig as read_rig
    from urdfcal.io.folder import read_session as read_session
    from urdfcal.io.folder import read_sessions as read_sessions
    from urdfcal.io.recorder import Recorder as Recorder
    from urdfcal.io.writing import write_session as write_session
    from urdfcal.output import recording
    from urdfcal.pipeline import calibrate as calibrate
    from urdfcal.planning.planner import Planner as Planner
    from urdfcal.result.calibration import Calibration as Calibration
    from urdfcal.result.fitted import FittedCalibration as FittedCalibration
    from urdfcal.robot.chain import Chain as Chain
    from urdfcal.robot.dh import DHTable as DHTable
    from urdfcal.robot.realtime import RealtimeKinematics as RealtimeKinematics
    from urdfcal.robot.urdf.urdf import Urdf as Urdf
    from urdfcal.session.combine import combine as combine
    from urdfcal.session.knowledge import Estimate as Estimate
    from urdfcal.session.knowledge import Led as Led
    from urdfcal.session.knowledge import LedDistance as LedDistance
    from urdfcal.session.knowledge import Noise as Noise
    from urdfcal.session.knowledge import Payload as Payload
    from urdfcal.session.knowledge import PlaceDistance as PlaceDistance
    from urdfcal.session.knowledge import Tolerances as Tolerances
    from urdfcal.session.model import Session as Session
    from urdfcal.session.model import Setup as Setup

    log = recording.log_calibration

_HOMES = {
    "urdfcal.pipeline": ("calibrate",),
    "urdfcal.planning.planner": ("Planner",),
    "urdfcal.errors": ("UrdfcalError",),
    "urdfcal.result.calibration": ("Calibration",),
    "urdfcal.result.fitted": ("FittedCalibration",),
    "urdfcal.robot.chain": ("Chain",),
    "urdfcal.robot.dh": ("DHTable",),
    "urdfcal.robot.realtime": ("RealtimeKinematics",),
    "urdfcal.robot.urdf.urdf": ("Urdf",),
    "urdfcal.io.folder": ("read_rig", "read_session", "read_sessions"),
    "urdfcal.io.writing": ("write_session",),
    "urdfcal.estimation.measurements": ("Contacts", "Detections", "Distances", "Planes", "Points", "Poses"),
    "urdfcal.session.combine": ("combine",),
    "urdfcal.session.knowledge": ("Estimate", "Led", "LedDistance", "Noise", "Payload", "PlaceDistance", "Tolerances"),
    "urdfcal.session.model": ("Session", "Setup"),
    "urdfcal.io.recorder": ("Recorder",),
    "urdfcal.cameras.camera": ("Camera",),
    "urdfcal.cameras.rig": ("Rig",),
}
_HOME_OF = {name: (home, name) for home, names in _HOMES.items() for name in names}
_HOME_OF["log"] = ("urdfcal.output.recording", "log_calibration")

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home, attribute = _HOME_OF[name]
    value = globals()[name] = getattr(import_module(home), attribute)
    return value


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
