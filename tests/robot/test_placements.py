from __future__ import annotations

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.robot.chain import Chain
from urdfcal.robot.placements import PlacementTable
from urdfcal.robot.urdf.packages import package_roots

UR5 = package_roots()[-1] / "example-robot-data" / "robots" / "ur_description" / "urdf" / "ur5_robot.urdf"


def test_twists_are_the_derivative_of_the_placements() -> None:
    table = PlacementTable(Chain.from_urdf(UR5, "tool0"))
    offsets = np.random.default_rng(0).normal(0.0, 0.3, (6, 6))
    G = table.twists(offsets, table.parameters)
    for column, (i, axis) in zip(G.T, table.parameters, strict=True):
        step = np.zeros((6, 6))
        step[i, table.columns.index(axis)] = 1e-6
        moved = table.placements(offsets + step) - table.placements(offsets - step)
        moved = inverse(table.placements(offsets)) @ moved / 2e-6
        twist = np.column_stack([moved[:, :3, 3], moved[:, 2, 1], moved[:, 0, 2], moved[:, 1, 0]])
        np.testing.assert_allclose(twist.ravel(), column, atol=1e-9)


def test_no_offset_leaves_a_joint_bit_for_bit() -> None:
    table = PlacementTable(Chain.from_urdf(UR5, "tool0"))
    offsets = np.zeros((6, 6))
    offsets[2, 4] = 0.1
    changed = np.any(table.placements(offsets) != table.chain.placements, axis=(1, 2))
    assert changed.tolist() == [False, False, True, False, False, False]
