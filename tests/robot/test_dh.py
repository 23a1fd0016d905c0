from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.arrays import inverse
from urdfcal.errors import RobotError
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import PARAMETERS, DHTable, row_transform
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.packages import package_roots
from urdfcal.robot.urdf.urdf import Urdf

ROBOTS = package_roots()[-1] / "example-robot-data" / "robots"
SHARED = Path(__file__).parents[3] / "shared" / "data"


@cache
def model_of(path: Path) -> pin.Model:
    return pin.buildModelFromUrdf(str(path))


def serial_chains() -> list[tuple[Path, str, str]]:
    """(file, base, tip) of every leaf joint that only one-degree-of-freedom joints connect to the root."""
    found = []
    for path in sorted(ROBOTS.rglob("*.urdf")):
        if path.name == "ur3.urdf":  # has no robot name: Pinocchio cannot load it
            continue
        model = model_of(path)
        links = {frame.parentJoint: frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
        root = next(frame.name for frame in model.frames if frame.type == pin.FrameType.BODY)
        parents = list(model.parents)
        for leaf in set(range(1, model.njoints)) - set(parents[1:]):
            found.append((path, root, links[leaf]))
            above = parents[leaf]
            if above and len(found) % 5 == 0:  # and some whose base is inside the tree
                found.append((path, links[above] if parents[above] == 0 else links[parents[above]], links[leaf]))
    return found


CHAINS = serial_chains()


@cache
def table_of(path: Path, base: str, tip: str) -> DHTable:
    return DHTable.from_chain(Chain.from_model(model_of(path), tip, base))


def offsets_of(table: DHTable, rng: np.random.Generator, scale: float) -> np.ndarray:
    offsets = rng.normal(0.0, scale, table.nominal.shape)
    last = PARAMETERS.index(table.rows[-1].variable)
    offsets[-1, np.arange(5) != last] = 0.0
    return offsets


def test_there_are_as_many_chains_as_expected() -> None:
    assert len(CHAINS) > 285 + 50


@pytest.mark.no_cover
@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_fk_of_the_rows_is_pinocchios(convention: Any) -> None:
    # Written out here from the JSON, so that what is printed is checked, not how it was computed.
    rng = np.random.default_rng(1)
    for path, base, tip in CHAINS:
        model = model_of(path)
        data = model.createData()
        table = table_of(path, base, tip)
        printed = json.loads(json.dumps(table.to_dict(convention)))
        for _ in range(3):
            q, T = pin.neutral(model), np.array(printed["base"])
            for row in printed["rows"]:
                joint = model.joints[model.getJointId(row["joint"])]
                value = rng.uniform(-3.0, 3.0)
                q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else [np.cos(value), np.sin(value)]
                turn, slide = (0.0, value) if row["type"] == "prismatic" else (value, 0.0)
                own = row_transform([row["theta"] + turn, row["d"] + slide, 0.0, 0.0, 0.0])
                normal = row_transform([0.0, 0.0, row["a"], row["alpha"], row["beta"]])
                T = T @ own @ normal if convention == "standard" else T @ normal @ own
            pin.framesForwardKinematics(model, data, q)
            ends = [data.oMf[model.getFrameId(link, pin.FrameType.BODY)] for link in (base, tip)]
            expected = (ends[0].inverse() * ends[1]).homogeneous
            np.testing.assert_allclose(T @ printed["tool"], expected, atol=1e-10, err_msg=f"{path.name} {base} {tip}")


def test_parameters_stay_within_the_robots_size() -> None:
    # Plain DH needs hundreds of metres where axes are almost parallel.
    for path, base, tip in CHAINS:
        table = table_of(path, base, tip)
        assert np.abs(table.nominal[:, 1:3]).max() < 3.0, (path.name, tip)
        assert not np.any(table.nominal[[not row.parallel for row in table.rows], 4])


def test_corrected_placements_move_as_the_corrected_rows_do() -> None:
    rng = np.random.default_rng(2)
    for path, base, tip in CHAINS:
        table = table_of(path, base, tip)
        for scale in (1e-3, 1e-2):
            offsets = offsets_of(table, rng, scale)
            q = rng.uniform(-3.0, 3.0, (2, len(table.rows)))
            by_placements = tip_poses(table.chain, q, table.placements(offsets))
            by_rows = [table.forward(q_k, offsets) for q_k in q]
            np.testing.assert_allclose(by_placements, by_rows, atol=1e-10, err_msg=f"{path.name} {base} {tip}")


def test_no_offset_leaves_the_placements_bit_for_bit() -> None:
    for path, base, tip in CHAINS[::10]:
        table = table_of(path, base, tip)
        np.testing.assert_array_equal(table.placements(np.zeros_like(table.nominal)), table.chain.placements)
        one = np.zeros_like(table.nominal)
        one[0, PARAMETERS.index(table.rows[0].variable)] = 0.01
        changed = np.any(table.placements(one) != table.chain.placements, axis=(1, 2))
        assert changed.tolist() == [True] + [False] * (len(table.rows) - 1)


def test_an_offset_of_the_tip_on_its_link_is_refused() -> None:
    table = DHTable.from_chain(Chain.from_urdf(ROBOTS / "panda_description" / "urdf" / "panda.urdf", "panda_link8"))
    offsets = np.zeros_like(table.nominal)
    offsets[-1, PARAMETERS.index("a")] = 0.001
    with pytest.raises(RobotError, match=r"panda_joint7.*only be offset in its joint variable"):
        table.placements(offsets)


def test_twists_are_the_derivative_of_the_placements() -> None:
    rng = np.random.default_rng(3)
    chosen = [chain for chain in CHAINS if chain[0].stem in ("ur5_robot", "panda", "tiago", "pr2", "kinova")][::3]
    assert len(chosen) > 8
    for path, base, tip in chosen:
        table = table_of(path, base, tip)
        offsets = offsets_of(table, rng, 0.02)
        last = len(table.rows) - 1
        parameters = [(i, p) for i, row in enumerate(table.rows) for p in PARAMETERS if i < last or p == row.variable]
        G = table.twists(offsets, parameters)
        for column, (i, name) in zip(G.T, parameters, strict=True):
            step = np.zeros_like(offsets)
            step[i, PARAMETERS.index(name)] = 1e-6
            before, after = table.placements(offsets - step), table.placements(offsets + step)
            moved = inverse(table.placements(offsets)) @ (after - before) / 2e-6
            twist = np.column_stack([moved[:, :3, 3], moved[:, 2, 1], moved[:, 0, 2], moved[:, 1, 0]])
            np.testing.assert_allclose(twist.ravel(), column, atol=2e-9, err_msg=f"{path.name} {tip} {i} {name}")


def test_rows_do_not_depend_on_where_the_base_stands() -> None:
    # The first row's theta and d hang on the base frame; everything after does not.
    text = (ROBOTS / "ur_description" / "urdf" / "ur5_robot.urdf").read_text()
    origin = '<origin rpy="0.0 0.0 0.0" xyz="0.0 0.0 0.089159"/>'
    moved = text.replace(origin, '<origin rpy="0.3 -0.2 0.9" xyz="1 2 3"/>')
    assert moved != text
    tables = [DHTable.from_chain(Chain.from_urdf(Urdf.parse(t.encode()), "tool0", "base_link")) for t in (text, moved)]
    np.testing.assert_allclose(tables[0].nominal[1:], tables[1].nominal[1:], atol=1e-12)


@pytest.mark.parametrize(
    ("angle", "parallel"), [(0.0, True), (0.013, True), (0.099, True), (0.101, False), (1.0, False)]
)
def test_near_parallel_axes_get_a_beta_and_no_far_normal(angle: float, parallel: bool) -> None:
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    text = (
        '<robot name="r"><link name="a"/><link name="b"/><link name="c"/>'
        f'<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>{limit}</joint>'
        f'<joint name="k" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.4 0.1 0.2" '
        f'rpy="{angle} 0 0"/><axis xyz="0 0 1"/>{limit}</joint></robot>'
    )
    row = DHTable.from_chain(Chain.from_model(pin.buildModelFromXML(text), "c")).rows[0]
    assert row.parallel is parallel
    assert row.free == (("theta", "a", "alpha", "beta") if parallel else ("theta", "d", "a", "alpha"))
    assert max(abs(row.values[1]), abs(row.values[2])) < 6.0


def shared_table(name: str) -> dict[str, Any]:
    path = SHARED / "dh_tables.json"
    if not path.exists():
        pytest.skip(f"the reference tables are not here: {path}")
    return json.loads(path.read_text())[name]


def published(name: str) -> np.ndarray:
    return np.array([[row[k] for k in ("theta_offset", "d", "a", "alpha")] for row in shared_table(name)["rows"]])


def angle_difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def test_the_ur5_table_is_the_published_one() -> None:
    # Universal Robots' own `base` frame is base_link turned by 180 degrees: every x axis points the other
    # way, which changes the signs of a and alpha and nothing else.
    path = ROBOTS / "ur_description" / "urdf" / "ur5_robot.urdf"
    ours = DHTable.from_chain(Chain.from_urdf(path, "tool0", "base_link")).nominal
    theirs = published("ur5") * [1, 1, -1, -1]
    np.testing.assert_allclose(ours[:, :4], theirs, atol=1e-6)
    np.testing.assert_allclose(ours[:, 4], 0.0, atol=1e-6)


def test_the_panda_table_is_the_published_one() -> None:
    # Craig's rows; the flange, which Franka lists as an eighth row, is our tool.
    path = ROBOTS / "panda_description" / "urdf" / "panda.urdf"
    table = DHTable.from_chain(Chain.from_urdf(path, "panda_link8")).to_dict("modified")
    ours = np.array([[row[k] for k in ("theta", "d", "a", "alpha")] for row in table["rows"]])
    np.testing.assert_allclose(ours, published("panda"), atol=1e-6)
    np.testing.assert_allclose(np.array(table["tool"])[:3, 3], [0.0, 0.0, 0.107], atol=1e-6)


def test_the_irb120_table_is_the_published_one() -> None:
    # The published last theta of 180 degrees is a constant rotation about the flange's axis: our tool.
    theirs = published("irb120")
    table = DHTable.from_chain(Chain.from_urdf(SHARED / "irb120_liaowu" / "irb120.urdf", "tool0"))
    assert np.all(angle_difference(table.nominal[:5, 0], theirs[:5, 0]) < 1e-6)
    assert np.all(angle_difference(table.nominal[:, 3], theirs[:, 3]) < 1e-6)
    np.testing.assert_allclose(table.nominal[:, 1:3], theirs[:, 1:3], atol=1e-6)
    np.testing.assert_allclose(table.tool[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-6)
