"""What session.yaml and torques.csv say of arms that bend, and the order in which they went through their poses."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from tests.io.making import ACTUATED, POSES, measured, write_valid
from urdfcal.errors import SessionError
from urdfcal.estimation.joint_models import joint_models_of
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_session
from urdfcal.io.writing import write_session
from urdfcal.session.exclusion import restored

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.session.model import Session

LOADS = """payload: {link: finger, mass: 1.2, center: [0, 0.01, 0.05]}
gravity: [0, 9.81, 0]
gear_ratio: {roll: 121}
joint_models: {gain: on, lag: off, harmonics: {waist: on}}
"""


def session_with(folder: Path, more: str = "", **files: str) -> Session:
    write_valid(folder)
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text)
    with (folder / "session.yaml").open("a") as file:
        file.write(more)
    return read_session(folder)


def joints(rows: list[str], *more: str) -> str:
    return "\n".join([",".join(["pose", *ACTUATED, *more]), *rows]) + "\n"


def rows_of(poses: list[int], labels: str = "{}") -> list[str]:
    readings = measured()[0].tolist()
    return [",".join([labels.format(k), *map(str, readings[k])]) for k in poses]


def torques_of(poses: list[int]) -> str:
    return joints([f"{k},{k}.5,-1,0,{k + 0.1}" for k in poses])


def refused(folder: Path, more: str = "", **files: str) -> str:
    with pytest.raises(SessionError) as caught:
        session_with(folder, more, **files)
    return str(caught.value)


def test_loads_are_read_and_written_back(tmp_path: Path) -> None:
    read = session_with(tmp_path / "a", LOADS)
    write_session(tmp_path / "b", read)
    for session in (read, read_session(tmp_path / "b")):
        assert (session.payload.link, session.payload.mass) == ("finger", 1.2)
        assert session.payload.center.tolist() == [0.0, 0.01, 0.05]
        assert session.gravity.tolist() == [0.0, 9.81, 0.0]
        assert dict(session.gear_ratio) == {"roll": 121.0}
        assert dict(session.joint_models) == {"gain": True, "lag": False, "harmonics": {"waist": True}}
    quoted = session_with(tmp_path / "quoted", 'joint_models: {gain: "on", lag: "off", harmonics: {waist: "on"}}\n')
    assert dict(quoted.joint_models) == dict(read.joint_models)
    plain = session_with(tmp_path / "c")
    assert plain.payload is None
    assert plain.gravity.tolist() == [0.0, 0.0, -9.81]
    write_session(tmp_path / "d", plain)
    said = yaml.safe_load((tmp_path / "d" / "session.yaml").read_text())
    assert not {"payload", "gravity", "gear_ratio", "joint_models", "torques"} & set(said)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("payload: {link: fingr, mass: 1, center: [0, 0, 0]}", r"12:11, key 'payload\.link'.*'fingr'.*'finger'"),
        ("payload: {link: tip, mass: 0, center: [0, 0, 0]}", "0 is not greater than 0"),
        ("payload: {link: tip, mass: 1}", "the key 'center' is missing"),
        ("gravity: [0, 0, -981]", r"session.yaml:12:1, key 'gravity': gravity of 981 m/s\^2.*in the base link's frame"),
        (
            "gravity: {direction: free}",
            r"gravity: where gravity points shows in how .*no masses.*Write it as \[x, y, z",
        ),
        ("gravity: {direction: up}", "key 'gravity.*direction.*free"),
        ("gear_ratio: {rol: 121}", "key 'gear_ratio.rol': .*'roll'"),
        ("gear_ratio: {roll: -121}", "-121 is not greater than 0"),
        ("gear_ratio: {elbow: 121}", "elbow"),  # a mimic joint has no reading of its own
        ("joint_models: {harmonics: {wast: on}}", "key 'joint_models.harmonics': .*'wast'.*'waist'"),
        ("joint_models: {harmonics: {waist: 1}}", "1 stands where on or off belongs"),
        ("joint_models: {zero_offset: {waist: on}}", "zero_offset is not a matter of single joints"),
    ],
)
def test_loads_that_cannot_be_are_refused_with_their_place(tmp_path: Path, more: str, message: str) -> None:
    with pytest.raises(SessionError) as caught:
        joint_models_of(session_with(tmp_path, more + "\n"))
    assert re.search(message, str(caught.value), re.DOTALL), caught.value


def test_a_payload_without_a_robot_description_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="payload: without a URDF"):
        replace(session_with(tmp_path, LOADS), urdf=None)


def test_torques_are_those_of_their_poses(tmp_path: Path) -> None:
    session = session_with(tmp_path / "a", "torques: torques.csv\n", torques=torques_of([7, 6, 5, 4, 3, 2, 1, 0]))
    assert session.torques[:, session.chain.names.index("waist")].tolist() == [k + 0.5 for k in range(POSES)]
    assert session.torques[:, session.chain.names.index("elbow")].tolist() == [0.0] * POSES  # mimics the shoulder
    assert "torques.csv" in session.sha256
    write_session(tmp_path / "b", session)
    np.testing.assert_array_equal(read_session(tmp_path / "b").torques, session.torques)
    np.testing.assert_array_equal(session.at(np.array([2, 5, 6])).torques, session.torques[[2, 5, 6]])


def test_a_measured_pose_without_torques_is_refused_and_another_one_is_where_the_arm_was(tmp_path: Path) -> None:
    key, some = "torques: torques.csv\n", torques_of([0, 1, 2, 4, 5, 6, 7])
    message = refused(tmp_path / "a", key, torques=some)
    assert "joints.csv:5:1: pose '3' has no torques, and something was measured in it" in message
    assert "Add its row to" in message
    lines = (tmp_path / "a" / "detections.csv").read_text().splitlines()
    unseen = "\n".join(line for line in lines if not line.startswith("3,")) + "\n"
    session = session_with(tmp_path / "b", key, torques=some, detections=unseen)
    whole = session_with(tmp_path / "c")
    assert session.poses == ("0", "1", "2", "4", "5", "6", "7")
    np.testing.assert_array_equal(session.q, whole.q[[0, 1, 2, 4, 5, 6, 7]])
    np.testing.assert_array_equal(session.came_from, whole.q[[0, 0, 1, 3, 4, 5, 6]])
    assert session.find(Detections).pose.max() == 6
    write_session(tmp_path / "d", session)
    again = read_session(tmp_path / "d")
    assert again.poses == session.poses
    np.testing.assert_array_equal(again.came_from, session.came_from)
    np.testing.assert_array_equal(again.torques, session.torques)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("\n3,", "\n8,"), "torques.csv:5:1: there is no pose '8'"),
        (lambda text: text.replace("\n3,", "\n2,"), "torques.csv:5:1: pose '2' is already in line 4. Keep one"),
        (lambda text: text.replace("3.5", "nan"), "torques.csv:5:3: waist: nan is not a finite number"),
        (lambda text: text.replace("roll", "rol"), "torques.csv:1: unknown column 'rol'"),
    ],
)
def test_torques_that_cannot_be_are_refused_with_their_place(tmp_path: Path, change: Any, message: str) -> None:
    assert message in refused(tmp_path, "torques: torques.csv\n", torques=change(torques_of(list(range(POSES)))))


def test_an_arm_on_its_way_has_neither_torques_nor_poses_before(tmp_path: Path) -> None:
    for name in ("torques", "previous"):
        message = refused(tmp_path, f"frames: frames.csv\n{name}: {name}.csv\n")
        assert f"{name} belongs to an arm that stands still" in message


def test_poses_in_which_nothing_was_measured_are_where_the_arm_came_from(tmp_path: Path) -> None:
    via = "via,0.4,0.2,0.1,1"
    rows = rows_of(list(range(POSES)))
    session = session_with(tmp_path, joints=joints([*rows[:4], via, *rows[4:]]))
    chain, at = session.chain, session.poses.index
    np.testing.assert_array_equal(chain.readings(session.came_from)[at("4")], [0.4, 0.2, 0.1, 1.0])
    np.testing.assert_array_equal(session.came_from[at("3")], session.q[at("2")])
    np.testing.assert_array_equal(session.came_from[0], session.q[0])
    # Whatever is left of the session: of folds, of bootstraps, and after exclusion.
    few = session.at(np.array([at("0"), at("4"), at("6"), at("7")]))
    np.testing.assert_array_equal(few.came_from, session.came_from[[0, at("4"), at("6"), at("7")]])
    np.testing.assert_array_equal(few.at(np.array([1, 2, 3])).came_from, few.came_from[1:])
    left = read_session(tmp_path, exclude_poses=["3", "5"])
    np.testing.assert_array_equal(left.came_from[left.poses.index("6")], session.q[at("5")])
    np.testing.assert_array_equal(restored(left).came_from, session.came_from)
    assert np.isfinite(left.came_from).all()


def test_where_the_arm_came_from_may_be_said_of_some_poses(tmp_path: Path) -> None:
    said = joints(["4,0.4,0.2,0.1,1", "0,-0.4,0.2,0.1,1"])
    session = session_with(tmp_path / "a", "previous: previous.csv\n", previous=said)
    came = session.chain.readings(session.came_from)
    assert came[[0, 4]].tolist() == [[-0.4, 0.2, 0.1, 1.0], [0.4, 0.2, 0.1, 1.0]]
    np.testing.assert_array_equal(session.came_from[[1, 2, 3, 5]], session.q[[0, 1, 2, 4]])
    assert "previous.csv" in session.sha256
    message = refused(tmp_path / "b", "previous: previous.csv\n", previous=said.replace("\n4,", "\n9,"))
    assert "previous.csv:2:1: there is no pose '9'" in message


def test_time_tells_the_order_where_there_is_one(tmp_path: Path) -> None:
    time = np.array([3.0, 1.0, 0.0, 2.0, 7.0, 6.0, 5.0, 4.0])
    rows = [f"{row},{t}" for row, t in zip(rows_of(list(range(POSES))), time, strict=True)]
    session = session_with(tmp_path, joints=joints(rows, "time"))
    np.testing.assert_array_equal(session.came_from, session.q[[3, 2, 2, 1, 5, 6, 7, 0]])


@pytest.mark.parametrize("timed", [False, True])
def test_some_poses_are_written_with_where_the_arm_came_from(tmp_path: Path, timed: bool) -> None:
    time = np.random.default_rng(3).permutation(POSES).astype(float)
    rows = rows_of(list(range(POSES)))
    rows = [f"{row},{t}" for row, t in zip(rows, time, strict=True)] if timed else rows
    some = session_with(tmp_path / "a", joints=joints(rows, *["time"] * timed)).at(np.array([1, 2, 5, 7]))
    write_session(tmp_path / "b", some)
    read = read_session(tmp_path / "b")
    assert read.poses == some.poses
    np.testing.assert_array_equal(read.came_from, some.came_from)
    whole = session_with(tmp_path / "c", joints=joints(rows, *["time"] * timed))
    write_session(tmp_path / "d", whole)
    assert not (tmp_path / "d" / "previous.csv").exists()
