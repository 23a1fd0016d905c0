"""Geometric errors of real robots: random offsets of DH rows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.robot.dh import PARAMETERS, DHTable

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.robot.dh import DHRow, Parameter
    from urdfcal.robot.tree_dh import TreeTable

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


def draw_offsets(table: DHTable | TreeTable, rng: np.random.Generator) -> Floats:
    """Draw the offsets of a true robot's DH rows from the nominal ones.

    Zero offsets are uniform in magnitude, 1-5 mrad (a sliding joint's 0.2-0.8 mm), with either sign; the
    other parameters that a row has free are normal, with the spread measured on real robots.

    What one LED of unknown position cannot identify stays nominal: theta and d of the first row, which only move
    the base, and the last row, which only moves the LED and the tip on the last link.

    Args:
        table: of the nominal robot.
        rng: the source of randomness; what is drawn for a row does not depend on the other rows.

    Returns:
        (n, 5) offsets, columns as ``PARAMETERS``; of a tree a row for every label. [rad, m]
    """
    if isinstance(table, DHTable):
        return _draw_rows(table, rng, offset_base=False)
    rows: list[Floats] = []
    for branch in table.branches:
        if branch.mount is not None:
            spread = {"theta": _ALPHA, "d": _D, "a": _A, "alpha": _ALPHA, "beta": 0.0}
            free = [spread[name] * (name in branch.mount.free) for name in PARAMETERS]
            rows.append((rng.standard_normal(len(PARAMETERS)) * free)[None])
        rows.append(_draw_rows(branch.table, rng, offset_base=branch.mount is not None))
    return np.concatenate(rows)


def _draw_rows(table: DHTable, rng: np.random.Generator, *, offset_base: bool) -> Floats:
    """Draw the rows of one chain; with ``offset_base`` theta and d of the first one too."""
    shape = (len(table.rows), len(PARAMETERS))
    normal, magnitude, sign = rng.standard_normal(shape), rng.random(shape[0]), rng.integers(0, 2, shape[0])
    offsets = np.zeros(shape)
    for i, row in enumerate(table.rows[:-1]):
        for name in row.free:
            column = PARAMETERS.index(name)
            if i == 0 and not offset_base and name in ("theta", "d"):
                continue
            if name == row.variable:
                least, most = _ZERO_LENGTH if row.type == "prismatic" else _ZERO_ANGLE
                offsets[i, column] = (1 - 2 * sign[i]) * (least + magnitude[i] * (most - least))
            else:
                offsets[i, column] = normal[i, column] * _spread(row, name)
    return offsets


def _spread(row: DHRow, name: Parameter) -> float:
    if name == "d":
        return _D
    if name == "a":
        return _A
    if not row.parallel:
        return _ALPHA
    return _BETA_PARALLEL if name == "beta" else _ALPHA_PARALLEL
