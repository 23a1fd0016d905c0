"""LeRobot's calibration of an arm's motors: between which steps of its encoder each of them goes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from pathlib import Path

STEPS = 4095
"""Steps of a turn of Feetech's STS3215, less one, as lerobot.motors.motors_bus takes it for degrees."""

RANGE = ("range_min", "range_max")
"""The keys of both ends of a motor's range."""


def read_motors(path: Path) -> dict[str, dict[str, Any]]:
    """Read the JSON file: of each motor its id, drive mode, homing offset and range, in steps.

    Raises:
        SessionError: it cannot be read, or is no such file.
    """
    try:
        motors = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SessionError(f"cannot be read: {error}", where=str(path), remedy="Name LeRobot's calibration.") from error
    whole = isinstance(motors, dict) and all(
        isinstance(motor, dict) and all(type(motor.get(key)) is int for key in RANGE) for motor in motors.values()
    )
    if not whole:
        what = "no motor calibration of LeRobot: each motor has range_min and range_max, whole numbers"
        raise SessionError(what, where=str(path), remedy="It is in ~/.cache/huggingface/lerobot/calibration.")
    for name, motor in motors.items():
        low, high = (motor[key] for key in RANGE)
        if low >= high:
            what = f"motor {name!r}: range_min {low} is not below range_max {high}"
            raise SessionError(what, where=str(path), remedy="Run lerobot-calibrate again: move it through its range.")
    result: dict[str, dict[str, Any]] = motors
    return result
