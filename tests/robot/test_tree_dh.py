from __future__ import annotations

import numpy as np
import pytest

from tests.robot.test_chain import PANDA, TREES, read
from urdfcal.robot.chain import Chain, Tree
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.robot.kinematics import link_motions, link_poses
from urdfcal.robot.mechanism import BASE
from urdfcal.robot.placements import PlacementTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.urdf import Urdf


@pytest.fixture(params=[*TREES, "shoulders"])
def tree(request: pytest.FixtureRequest) -> Tree:
    if request.param != "shoulders":
        return read(request.param)[0]
    # Two arms back to back: their first axes are one line, in opposite directions.
    body = "".join(f'<link name="{link}"/>' for link in ("base", "l1", "l2", "r1", "r2"))
    for name, parent, child, rpy, xyz in (
        ("left1", "base", "l1", "-1.5707963267948966 0 0", "0 0.2 0.5"),
        ("left2", "l1", "l2", "1.2 0.3 0", "0.1 0 0.4"),
        ("right1", "base", "r1", "1.5707963267948966 0 0", "0 -0.2 0.5"),
        ("right2", "r1", "r2", "1.2 0.3 0", "0.1 0 0.4"),
    ):
        body += (
            f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/></joint>'
        )
    return Tree.from_urdf(Urdf.parse(f'<robot name="r">{body}</robot>'.encode()), ["l2", "r2"], "base")


def random_offsets(table: DHTable, seed: int) -> np.ndarray:
    offsets = np.zeros((len(table.labels), 5))
    rng = np.random.default_rng(seed)
    for row, name in table.parameters:
        offsets[row, PARAMETERS.index(name)] = rng.normal(0.0, 2e-3)
    return offsets


def test_a_nominal_arm_keeps_its_placements_bit_for_bit(tree: Tree) -> None:
    table = rows_of(tree)
    np.testing.assert_array_equal(table.placements(np.zeros((len(table.labels), 5))), tree.placements)


def test_each_row_follows_that_of_the_joint_above_or_its_mount(tree: Tree) -> None:
    table = rows_of(tree)
    for row, before in zip(table.rows, table.following, strict=True):
        parent = tree.parents[tree.names.index(row.joint)]
        mount = row.joint + ".mount"
        if not row.mount and mount in table.labels:
            assert table.labels[before - 1] == mount
        elif parent == BASE:
            assert before is None
        else:
            assert table.labels[before - 1] == tree.names[parent]


def test_of_a_chain_nothing_is_said_of_what_follows_what() -> None:
    assert rows_of(Chain.from_urdf(PANDA, "panda_link8")).following == ()


def test_labels_name_joints_and_mounts(tree: Tree) -> None:
    table = rows_of(tree)
    assert table.nominal.shape == (len(table.labels), 5)
    assert [label for label in table.labels if not label.endswith(".mount")] == [
        tree.names[i] for run in tree.branches for i in run
    ]
    assert sum(label.endswith(".mount") for label in table.labels) == len(tree.branches) - 1


def test_twists_agree_with_finite_differences(tree: Tree) -> None:
    table = rows_of(tree)
    offsets, parameters = random_offsets(table, 0), table.parameters
    q = tree.random_values(3, np.random.default_rng(0))
    model = tree.build_model(table.placements(offsets))
    G = table.twists(offsets, parameters)
    motions = link_motions(tree, model, q, tree.tips)
    for column, (row, name) in enumerate(parameters):
        step = np.zeros_like(offsets)
        step[row, PARAMETERS.index(name)] = 1e-6
        before, after = (link_poses(tree, q, tree.tips, table.placements(offsets + s * step)) for s in (-1, 1))
        for motion, a, b in zip(motions, before, after, strict=True):
            expected = (b[:, :3, 3] - a[:, :3, 3]) / 2e-6
            np.testing.assert_allclose((motion.regressor @ G)[:, :3, column], expected, atol=1e-8, err_msg=name)


def test_rows_lose_nothing_that_whole_placements_identify(tree: Tree) -> None:
    """With base and LEDs free, the rows span every motion of the LEDs that any misplaced joints can cause."""
    table, placements = rows_of(tree), PlacementTable(tree)
    q = tree.random_values(60, np.random.default_rng(3))
    leds = np.random.default_rng(4).normal(0.0, 0.05, (len(tree.tips), 3))
    motions = link_motions(tree, tree.build_model(), q, tree.tips)

    def jacobian(G: np.ndarray) -> np.ndarray:
        blocks = []
        for i, (motion, led) in enumerate(zip(motions, leds, strict=True)):
            lever = motion.R @ led
            cross = lambda a: -np.cross(np.eye(3), a[:, None])  # noqa: E731
            v = motion.regressor[:, :3] @ G + cross(lever) @ (motion.regressor[:, 3:] @ G)
            base = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), cross(motion.p + lever)], axis=2)
            bulbs = np.zeros((len(q), 3, 3 * len(leds)))
            bulbs[:, :, 3 * i : 3 * i + 3] = motion.R
            blocks.append(np.concatenate([v, base, bulbs], axis=2).reshape(3 * len(q), -1))
        return np.concatenate(blocks)

    def rank(J: np.ndarray) -> int:
        norms = np.linalg.norm(J, axis=0)
        singular = np.linalg.svd(J / np.maximum(norms, 1e-9), compute_uv=False)
        return int(np.sum(singular > 1e-9 * singular[0]))

    by_rows = jacobian(table.twists(np.zeros((len(table.labels), 5)), table.parameters))
    by_placements = jacobian(placements.twists(np.zeros((len(tree.joints), 6)), placements.parameters))
    assert rank(by_rows) == rank(by_placements) == rank(np.hstack([by_rows, by_placements]))
