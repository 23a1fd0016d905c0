"""Where an arm will be used: a box, a path, a session, or what was measured; ``--workspace``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.found import FoundJointModels
    from urdfcal.result.calibration import Calibration


# On a path, as many as are drawn in a box.
_ON_PATH = 500


class Configurations(NamedTuple):
    """Joint readings in a workspace.

    Attributes:
        what: it is, in words.
        q: (N, k) of the actuated joints. [rad or m]
        torques: (N, k) measured, where there are any. [N m or N]
        previous: (N, k) where the arm came from, where that is known. [rad or m]
        bends: the arm's joint models with what it carried there; None for what it carried when it was calibrated.
    """

    what: str
    q: Floats
    torques: Floats | None = None
    previous: Floats | None = None
    bends: FoundJointModels | None = None


def along(q: Floats) -> Floats:
    """Return configurations (M, k) on the straight moves from row to row of (N, k), M about 500 unless there are more.

    A rigid arm that is fitted to few poses is bent to them: of 20 its tip was 0.8 mm off there, 1.2 mm between them.
    """
    from itertools import pairwise

    import numpy as np

    steps = -(-_ON_PATH // max(len(q) - 1, 1))
    if len(q) < 2 or steps == 1:  # no move
        return q
    share = np.arange(steps)[:, None] / steps
    moves = [a + share * (b - a) for a, b in pairwise(q)]
    return np.vstack([*moves, q[-1:]])


def configurations(calibration: Calibration, workspace: str | None) -> Configurations:
    """Take configurations of a workspace.

    Args:
        calibration: whose joints they are of.
        workspace: x0:x1,y0:y1,z0:z1 (m, in the base link's frame), a CSV file of joint readings, a session's folder or
            file; None for what was measured.

    Raises:
        click.BadParameter: it is a session of other joints.
        RobotError: it is none of these.
        OutputError: the box is hardly ever reached, or nothing is known of what was measured.
        SessionError: the path or session cannot be read.
    """
    from urdfcal.result.rigid import draw_readings, measured_domain

    if workspace is None:
        q = draw_readings(calibration, measured_domain(calibration))
        return Configurations("the measured domain", q)
    path = Path(workspace)
    if path.suffix == ".csv":
        from urdfcal.output.trajectory import CommandTable

        return Configurations(f"the moves of {workspace}", along(CommandTable.read(path, calibration.chain).q))
    if path.exists():
        from urdfcal.io.folder import read_session

        session = read_session(path)
        chain, torques = session.chain, session.torques
        if chain.actuated != calibration.chain.actuated:
            raise click.BadParameter(f"{workspace} is a session of other joints", param_hint="--workspace")
        measured = None if torques is None else chain.readings(torques)
        bends = calibration.joint_models.under(session)
        return Configurations(workspace, session.readings, measured, chain.readings(session.came_from), bends)
    from urdfcal.robot.box import parse_box

    q = draw_readings(calibration, measured_domain(calibration), parse_box(workspace))
    return Configurations(f"the box {workspace}", q)
