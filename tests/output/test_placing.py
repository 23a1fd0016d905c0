from __future__ import annotations

import numpy as np
import pytest

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.placing import joint_frames, place_rows
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.tree_dh import MOUNT, rows_of

RIGS = ("stanford", "tiago", "tiago_dual")


@pytest.fixture(params=RIGS)
def built(request):
    """A robot's rows, offsets of every free parameter, joint values and the frames that follow."""
    rng = np.random.default_rng(5)
    chain = read_rig(find_rig(request.param)).chain
    table = rows_of(chain)
    offsets = np.zeros((len(table.labels), 5))
    for row, name in table.parameters:
        offsets[row, PARAMETERS.index(name)] = rng.normal(0, 0.01)
    q = chain.random_values(4, rng)
    return table, offsets, q, joint_frames(chain, table.placements(offsets), q)


def test_every_joint_turns_about_the_z_axis_that_its_row_starts_from(built):
    table, offsets, _, frames = built
    dh = place_rows(table, offsets, frames).frames
    chain = table.chain
    for j, joint in enumerate(chain.joints):
        F, L = dh[:, table.labels.index(joint.name)], frames[:, j + 1]
        axis = L[:, :3, :3] @ joint.axis
        np.testing.assert_allclose(F[:, :3, 2], axis, atol=1e-9)
        if not joint.prismatic:  # of a sliding joint's axis only the direction means something
            off = np.cross(F[:, :3, 3] - L[:, :3, 3], axis)
            np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_stretches_are_as_long_as_d_and_a(built):
    table, offsets, q, frames = built
    corners = place_rows(table, offsets, frames).corners
    lengths = np.linalg.norm(np.diff(corners, axis=2), axis=-1)
    values = np.broadcast_to(table.nominal + offsets, (len(q), *offsets.shape)).copy()
    for j, joint in enumerate(table.chain.joints):
        if joint.prismatic:
            values[:, table.labels.index(joint.name), 1] += q[:, j]
    np.testing.assert_allclose(lengths[..., 0], np.abs(values[..., 1]), atol=1e-9)
    np.testing.assert_allclose(lengths[..., 1], np.abs(values[..., 2]), atol=1e-9)


def test_every_branch_is_one_line_that_hangs_on_another_to_its_tip(built):
    table, offsets, q, frames = built
    chain, lines = table.chain, place_rows(table, offsets, frames).lines
    assert len(lines) == len(chain.branches) == 1 + sum(label.endswith(MOUNT) for label in table.labels)
    tips = link_poses(chain, q, chain.tips, table.placements(offsets))
    for k, (branch, line) in enumerate(zip(chain.branches, lines, strict=True)):
        carrier = frames[:, chain.parents[branch[0]] + 1]
        np.testing.assert_allclose(line[:, min(k, 1)], carrier[:, :3, 3], atol=1e-12)
        if k:  # it begins on a line that is drawn already, where a link's origin need not be
            apart = [np.linalg.norm(of - line[:, :1], axis=2).min(axis=1) for of in lines[:k]]
            np.testing.assert_allclose(np.min(apart, axis=0), 0.0, atol=1e-9)
        end = next(T for tip, T in zip(chain.tips, tips, strict=True) if tip.joint == branch[-1])
        np.testing.assert_allclose(line[:, -1], end[:, :3, 3], atol=1e-12)
