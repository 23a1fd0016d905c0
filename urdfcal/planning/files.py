"""Plans as files: joint values as joints.csv has them, and what drives an arm through them."""

from __future__ import annotations

import csv
import io
import json
import re
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import numpy as np

from urdfcal.io.tables import read_joints
from urdfcal.names import PASS, is_passed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.planning.planner import Plan
    from urdfcal.robot.mechanism import Mechanism

ProgramFormat: TypeAlias = Literal["urscript", "ros", "lerobot"]
FORMATS: tuple[ProgramFormat, ...] = get_args(ProgramFormat)

# Slow enough for any arm to be stopped by hand. [rad/s or m/s, rad/s^2 or m/s^2]
_SPEED, _ACCELERATION = 0.25, 0.5
# At rest before and while something is measured: an arm of 10 kg swings for half a second. [s]
_REST = 2.0
# Labels of more digits are a clock's, and no plan's.
_DIGITS = 4


def labels(plan: Plan) -> list[str]:
    """Name poses in the order of the moves: numbers, check1 and so on; pass1 and so on where the arm only passes.

    Where a plan goes on from a session, each kind goes on from the session's: poses of both can be told by their names.
    """
    numbers = {kind: _last(plan.before, kind) for kind in ("", "check", PASS)}
    width = len(str(numbers[""] + plan.count))
    names = []
    for rank, check in zip(plan.rank.tolist(), plan.check.tolist(), strict=True):
        kind = "" if rank >= 0 else "check" if check else PASS
        numbers[kind] += 1
        names.append(f"{numbers[kind]:0{width}d}" if rank >= 0 else f"{kind}{numbers[kind]}")
    return names


def _last(names: Collection[str], kind: str) -> int:
    """The largest number among names of a kind; 0 where there is none."""
    found = (re.fullmatch(rf"{kind}(\d{{1,{_DIGITS}}})", name) for name in names)
    return max((int(of[1]) for of in found if of is not None), default=0)


def read_plan(path: Path, chain: Mechanism, *, passing: bool) -> tuple[tuple[str, ...], Floats]:
    """Read a table of poses, of a plan those that are measured.

    Args:
        path: as :func:`as_csv` writes it, or any joints.csv.
        chain: the arm.
        passing: whether those that the arm only passes through are read, too.

    Returns:
        Names, and joint values (N, n). [rad or m]

    Raises:
        SessionError: it cannot be read, with the place in the file.
    """
    table = read_joints(path, chain, chain.names)
    kept = [k for k, name in enumerate(table.poses) if passing or not is_passed(name)]
    return tuple(table.poses[k] for k in kept), chain.joint_values(table.readings[kept])


def as_csv(plan: Plan) -> str:
    """Write the plan as joints.csv: a label, and the actuated joints' values. [rad or m]."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["pose", *plan.chain.actuated])
    for label, values in zip(labels(plan), plan.chain.readings(plan.q).tolist(), strict=True):
        writer.writerow([label, *values])
    return text.getvalue()


def as_urscript(plan: Plan) -> str:
    """Write a program for a Universal Robot: straight moves in joint space, at rest in every pose.

    Its log names each pose when the arm has come to rest there, and says the joints' readings at the end of the rest.
    """
    lines = ["def measure():"]
    for label, measured, values in _rows(plan):
        lines.append(f"  movej([{', '.join(f'{value:.6f}' for value in values)}], a={_ACCELERATION}, v={_SPEED})")
        if measured:
            lines += [f'  textmsg("pose {label}")', f"  sleep({_REST})"]
            lines.append(f'  textmsg("joints of pose {label}: ", get_actual_joint_positions())')
    return "\n".join([*lines, "end", ""])


def as_ros(plan: Plan) -> str:
    """Write a trajectory_msgs/JointTrajectory as YAML; the arm rests in every pose that is measured."""
    import yaml

    time, points, before = 0.0, [], None
    for _, measured, values in _rows(plan):
        time += _REST if before is None else max(float(np.abs(np.subtract(values, before)).max()) / _SPEED, 1.0)
        for _ in range(2 if measured else 1):
            stamp = {"sec": int(time), "nanosec": int(1e9 * (time % 1.0))}
            points.append({"positions": list(values), "velocities": [0.0] * len(values), "time_from_start": stamp})
            time += _REST if measured else 0.0
        time -= _REST if measured else 0.0
        before = values
    return yaml.safe_dump(
        {"joint_names": list(plan.chain.actuated), "points": points},
        sort_keys=False,
        default_flow_style=None,
        width=110,
    )


def as_lerobot(plan: Plan) -> str:
    """Write actions for LeRobot's robots: positions in degrees (sliding joints in m), as with ``use_degrees``."""
    slides = [joint.prismatic for joint in plan.chain.actuated_joints]
    rows = []
    for label, measured, values in _rows(plan):
        degrees = np.where(slides, values, np.degrees(values)).tolist()
        action = {f"{name}.pos": value for name, value in zip(plan.chain.actuated, degrees, strict=True)}
        rows.append({"pose": label, "measure": measured, "action": action})
    return json.dumps(rows, indent=1) + "\n"


WRITERS: dict[ProgramFormat, tuple[str, Callable[[Plan], str]]] = {
    "urscript": (".script", as_urscript),
    "ros": (".yaml", as_ros),
    "lerobot": (".json", as_lerobot),
}
"""The suffix of each format's files, and what writes them."""


def _rows(plan: Plan) -> list[tuple[str, bool, list[float]]]:
    """Label, whether something is measured, and readings of each pose."""
    return list(zip(labels(plan), plan.measured.tolist(), plan.chain.readings(plan.q).tolist(), strict=True))
