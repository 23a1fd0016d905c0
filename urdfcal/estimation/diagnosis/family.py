"""Robots of the same joints and links, and whether an arm comes out as one of them (METHOD 15)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import rms
from urdfcal.errors import RobotError
from urdfcal.estimation.evaluation import compare
from urdfcal.robot.chain import Chain

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session

# Robots of one family that are tried; those that are so near to each other are one. [m, rad]
_FAMILY, _SAME = 20, 1e-4
# A correction that is to be undone must be seen, and what is left of it be small beside it.
_SEEN, _UNDONE = 3.0, 1.0 / 3.0
_CONFIGURATIONS = 100
# Drawings give lengths to tenths of a millimetre, seven digits at most; corrections are written as they come out.
_CORRECTED = 9.0


def family(session: Session) -> Iterator[tuple[Path, Chain]]:
    """List the robots of the same joints and links whose URDFs are beside the session's."""
    chain = session.chain
    if session.urdf is None or session.urdf.path is None or len(chain.tips) > 1:
        return
    known = [chain.placements]  # one arm may be there with several grippers
    for path in sorted(session.urdf.path.parent.glob("*.urdf"))[:_FAMILY]:
        try:
            other = Chain.from_urdf(path, chain.tip_link, chain.base_link)
        except RobotError:  # another kind of robot
            continue
        if other.names == chain.names and not any(np.allclose(other.placements, of, atol=_SAME) for of in known):
            known.append(other.placements)
            yield path, other


def undone(session: Session, calibrated: Mechanism, error: float) -> str | None:
    """Say whether a calibration takes back a correction that the session's URDF has over a simpler one beside it.

    Then the controller may apply the same correction, such as its factory calibration, to its readings already.

    Args:
        session: with the URDF that was calibrated.
        calibrated: the robot that was found.
        error: expected of its tip. [m]
    """
    if _digits(session.chain) < _CORRECTED:
        return None
    q = calibrated.random_values(_CONFIGURATIONS, np.random.default_rng(0))
    moved = rms(compare(calibrated, session.chain, q).position)
    if moved < _SEEN * error:
        return None
    for path, other in family(session):
        left = rms(compare(calibrated, other, q).position)
        if left < _UNDONE * moved and _digits(other) < _digits(session.chain):
            return (
                f"the arm comes out as {path.stem} has it ({1e3 * left:.2g} mm), which {session.chain.name} corrects "
                f"({1e3 * moved:.2g} mm): that correction is undone. Does the controller apply it to its readings "
                "already, as a factory calibration? Its readings belong to the URDF whose forward kinematics gives the "
                f"tool pose that the controller shows: if that is the corrected one, use {path.name} and correct once"
            )
    return None


def _digits(robot: Mechanism) -> float:
    """Mean number of digits of the joints' positions: a drawing's are round."""
    values = robot.placements[:, :3, 3].ravel()
    return float(np.mean([len(f"{abs(value):.12g}") for value in values if value] or [0]))
