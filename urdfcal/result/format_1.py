"""Files of format ``urdfcal/1``, which earlier versions wrote."""

from __future__ import annotations

from typing import Any

FORMAT_1 = "urdfcal/1"
_FORMAT_2 = "urdfcal/2"


def from_format_1(data: dict[str, Any]) -> dict[str, Any]:
    """Convert plain data of format ``urdfcal/1`` to ``urdfcal/2``; what is malformed stays so, for the reader to name.

    Placements ``drawn`` and ``built`` become ``nominal`` and ``calibrated``. There was no verdict: failures and
    warnings stood in one list, so that a result is called doubtful where it has any.
    """
    names = {"drawn": "nominal", "built": "calibrated"}
    robot = data.get("robot")
    joints = robot.get("joints") if isinstance(robot, dict) else None
    if isinstance(robot, dict) and isinstance(joints, dict):
        robot = {**robot, "joints": {name: _renamed(joint, names) for name, joint in joints.items()}}
    warnings = data.get("warnings")
    verdict = {
        "level": "doubtful" if warnings else "good",
        "sentence": "Check the warnings first." if warnings else "There are no warnings.",
        "reasons": warnings,
    }
    return {
        **data,
        **({"robot": robot} if robot is not None else {}),
        "verdict": verdict,
        "format": _FORMAT_2,
    }


def _renamed(entry: Any, names: dict[str, str]) -> Any:
    return {names.get(key, key): value for key, value in entry.items()} if isinstance(entry, dict) else entry
