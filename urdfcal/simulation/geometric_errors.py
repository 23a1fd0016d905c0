"""Geometric errors of real robots: random offsets of DH rows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.robot.dh import PARAMETERS

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.robot.dh import DHRow, DHTable

# Root mean squares over five Universal Robots (two UR5, a UR5e, two UR3) of the factory's calibration less the
# data sheet, as their owners published them. Rows 1 to 5: the factory leaves the last row's a and alpha alone.
# Alpha of parallel rows is the largest by far: 11.9 mrad on one UR3, and 2.5 mrad in the median.
_D = 0.76e-3
_A = 0.17e-3
_ALPHA = 0.74e-3
_ALPHA_PARALLEL = 4.5e-3
_BETA_PARALLEL = 1.5e-3
# The same robots leave the factory with zeros adjusted to 0.05 mrad; few others do. An arm that was assembled
# or repaired in the field is off by milliradians, with either sign, and so is every simulated one.
_ZERO_ANGLE = (1e-3, 5e-3)
# What a homing switch repeats to.
_ZERO_LENGTH = (0.2e-3, 0.8e-3)


def draw_offsets(table: DHTable, rng: np.random.Generator) -> Floats:
    """Draw the offsets of a true robot's DH rows from the nominal ones.

    Zero offsets are uniform in magnitude, 1-5 mrad (a sliding joint's 0.2-0.8 mm), with either sign; the
    other parameters that a row has free are normal, with the spread measured on real robots.

    What one LED of unknown position cannot identify stays nominal: theta and d of the first row, which only move
    the base, and the last row, which only moves the LED and the tip on the last link.

    Args:
        table: of the nominal robot.
        rng: the source of randomness; what is drawn for a row does not depend on the other rows of its branch.

    Returns:
        (R, 5) offsets, columns as ``PARAMETERS``. [rad, m]
    """
    drawn: list[Floats] = []
    for branch in table.chain.branches:
        if table.rows[len(drawn)].mount:
            drawn.append(rng.standard_normal(len(PARAMETERS)) * _spreads(table.rows[len(drawn)]))
        shape = (len(branch), len(PARAMETERS))
        normal, magnitude, sign = rng.standard_normal(shape), rng.random(shape[0]), rng.integers(0, 2, shape[0])
        for i in range(len(branch)):
            row = table.rows[len(drawn)]
            least, most = _ZERO_LENGTH if row.type == "prismatic" else _ZERO_ANGLE
            zero = (1 - 2 * sign[i]) * (least + magnitude[i] * (most - least))
            own = np.array([name == row.variable for name in PARAMETERS])
            drawn.append(np.where(own, zero, normal[i] * _spreads(row)) * (not row.last))
    drawn[0][[PARAMETERS.index("theta"), PARAMETERS.index("d")]] = 0.0
    return np.array(drawn) + 0.0  # no "-0.0"


def _spreads(row: DHRow) -> list[float]:
    """Standard deviations (5,) of a row's parameters, 0 of those that it has not free."""
    angle = _ALPHA_PARALLEL if row.parallel else _ALPHA
    spread = {"theta": angle, "d": _D, "a": _A, "alpha": angle, "beta": _BETA_PARALLEL}
    return [spread[name] * (name in row.free) for name in PARAMETERS]
