from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.io.making import write_points, write_valid
from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.writing import write_session
from urdfcal.session.knowledge import Estimate, Led, LedDistance, Noise, Tolerances
from urdfcal.session.rig_description import RigDescription, Stand

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.session.model import Session


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return read_session(write_valid(tmp_path_factory.mktemp("valid")))


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return read_session(write_points(tmp_path_factory.mktemp("tracked")))


def test_importing_it_brings_no_parser() -> None:
    code = "import sys, urdfcal.io.folder; print({'pydantic', 'yaml', 'pyarrow', 'cv2', 'rerun'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"


def test_its_arrays_cannot_be_written_to(session: Session, tracked: Session) -> None:
    arrays = [
        session.q,
        session.leds[0].position,
        *session.find(Detections).arrays.values(),
        *tracked.find(Points).arrays.values(),
    ]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = array[0]
    with pytest.raises(TypeError):
        session.sha256["a"] = "b"  # type: ignore[index]


def test_it_keeps_copies_of_what_it_was_given(session: Session) -> None:
    q = session.q.copy()
    kept = replace(session, q=q)
    q[:] = 0.0
    assert np.array_equal(kept.q, session.q)


def test_sightings_are_sorted_whatever_their_order(session: Session) -> None:
    table = session.find(Detections)
    assert table is not None
    order = np.random.default_rng(1).permutation(len(table))
    shuffled = Detections(**{name: column[order] for name, column in table.arrays.items()})
    for name, column in table.arrays.items():
        assert np.array_equal(getattr(shuffled, name), column)
    keys = np.stack([table.pose, table.camera, table.led], axis=1).tolist()
    assert keys == sorted(keys)


def test_one_sigma_serves_all_sightings() -> None:
    points = Points(np.arange(4), np.zeros(4, int), np.ones((4, 3)), 0.5)  # type: ignore[arg-type]
    assert points.sigma.tolist() == [0.5] * 4
    assert len(points) == 4


def test_readings_leave_out_the_mimic_joint(session: Session) -> None:
    assert session.chain.names == ("waist", "shoulder", "elbow", "slide", "roll")
    assert np.array_equal(session.readings, session.q[:, [0, 1, 3, 4]])
    assert np.allclose(session.q[:, 2], 0.1 - 1.5 * session.q[:, 1], rtol=0, atol=1e-15)


def test_it_travels_to_other_processes(session: Session) -> None:
    session = replace(session, tolerances=Tolerances(joints={"waist": {"a": 0.0}}))
    other = pickle.loads(pickle.dumps(session))  # noqa: S301
    assert np.array_equal(other.q, session.q)
    assert other.sha256 == session.sha256
    assert other.tolerances == session.tolerances
    assert not other.q.flags.writeable


def pixels(**changes: Any) -> Detections:
    values = {
        "pose": np.array([0, 1, 2]),
        "camera": np.array([0, 0, 1]),
        "led": np.zeros(3, int),
        "uv": np.full((3, 2), 100.0),
        "sigma": np.full(3, 0.1),
    }
    return Detections(**{**values, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"uv": np.ones((3, 3))}, r"uv has shape \(3, 3\), not \(3, 2\)"),
        ({"uv": np.full((3, 2), np.nan)}, "uv has values that are not finite"),
        ({"uv": [["a", "b"]] * 3}, "uv is not made of numbers"),
        ({"pose": np.array([0.0, 1.0, 2.0])}, "pose is not an array of 3 indices"),
        ({"pose": np.array([-1, 1, 2])}, "pose is not an array of 3 indices"),
        ({"camera": np.array([0, 0])}, "camera is not an array of 3 indices"),
        ({"sigma": np.ones(2)}, r"sigma has shape \(2,\), not \(3,\)"),
        ({"sigma": np.array([0.1, 0.0, 0.1])}, "sigma is 0; it must be positive"),
        ({"pose": np.array([0, 0, 2])}, "two measurements of pose 0, camera 0, led 0"),
        ({"pose": np.zeros(0, int)}, "there is no measurement"),
    ],
)
def test_sightings_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    assert len(pixels()) == 3
    with pytest.raises(SessionError, match=message):
        pixels(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"leds": ()}, "there is neither an LED nor a target"),
        ({"leds": (Led("a"), Led("a"))}, "two LEDs are named 'a'"),
        ({"leds": (Led("a "),)}, "'a ' begins or ends with a blank"),
        ({"q": np.zeros((8, 4))}, r"q has shape \(8, 4\), not \(8, 5\)"),
        ({"q": np.full((8, 5), np.inf)}, "q has values that are not finite"),
        ({"q": np.ones((8, 5))}, "a mimic joint's value in q is not what it follows from"),
        ({"poses": ("0", "1")}, "2 poses are too few"),
        ({"poses": tuple("01234566")}, "two poses are named '6'"),
        ({"poses": (*"0123456", "a\nb")}, "cannot be printed"),
        ({"time": np.zeros(3)}, r"time has shape \(3,\), not \(8,\)"),
        ({"rig": Rig()}, "there are detections, but no cameras"),
        ({"measurements": ()}, "there are no measurements"),
        ({"measurements": (pixels(pose=np.array([0, 1, 8])),)}, "pose 8 does not exist: there are 8"),
        ({"measurements": (pixels(camera=np.array([0, 2, 1])),)}, "camera 2 does not exist: there are 2"),
        ({"measurements": (pixels(led=np.array([0, 2, 1])),)}, "led 2 does not exist: there are 2"),
        ({"tolerances": Tolerances(joints={"wrist": {}})}, "there is no joint 'wrist'"),
        ({"estimate": Estimate(extrinsics={"cam9": "free"})}, "there is no camera 'cam9'"),
        ({"led_distances": (LedDistance(("red", "lamp"), 0.1, 1e-3),)}, "there is no LED 'lamp'"),
    ],
)
def test_sessions_that_do_not_fit_are_refused(session: Session, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SessionError, match=message):
        replace(session, **changes)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Led("a", sigma=0.1),
        lambda: Led("a", np.zeros(3), sigma=-0.1),
        lambda: Led("a", np.zeros(2)),
        lambda: Noise(pixel=0.0),
        lambda: Noise(point=np.nan),
        lambda: Noise(joint=-1.0),
        lambda: Noise(pixel=True),
        lambda: Noise(pixel="0.1"),  # type: ignore[arg-type]
        lambda: Estimate("hd"),  # type: ignore[arg-type]
        lambda: Estimate(intrinsics="none"),  # type: ignore[arg-type]
        lambda: Estimate(intrinsics={"cam0": "none"}),  # type: ignore[dict-item]
        lambda: Estimate(geometry={"cam0": "free"}),  # type: ignore[arg-type]
        lambda: LedDistance(("a", "a"), 0.1, 1e-3),
        lambda: LedDistance(("a", "b"), 0.0, 1e-3),
        lambda: LedDistance(("a", "b"), 0.1, -1e-3),
        lambda: Tolerances(length=-1.0),
        lambda: Tolerances(joints={"a": {"gamma": 1.0}}),
        lambda: Tolerances(joints={"a": {"theta": -1.0}}),
    ],
)
def test_values_without_sense_are_refused(make: Any) -> None:
    with pytest.raises(SessionError):
        make()


def test_numbers_and_names_of_numpy_become_plain_ones() -> None:
    led = Led(np.str_("a"), np.zeros(3), sigma=np.float32(0.5))  # type: ignore[arg-type]
    assert (type(led.name), type(led.sigma)) == (str, float)
    assert type(Noise(pixel=np.float64(0.5)).pixel) is float
    assert type(Tolerances(joints={"a": {"d": np.int64(1)}}).joints["a"]["d"]) is float


def test_zero_means_exactly_where_that_makes_sense() -> None:
    assert Led("a", np.zeros(3), sigma=0.0).sigma == 0.0
    assert Noise(joint=0.0).reading == Noise().reading == 0.0
    assert Noise(joint=0.0) != Noise()  # of nothing said it is estimated
    assert Tolerances(zero=0.0, joints={"a": {"theta": 0.0}}).joints["a"]["theta"] == 0.0


def test_nothing_is_decided_for_the_calibration() -> None:
    assert Estimate() == Estimate(geometry=None, intrinsics=None, extrinsics=None)


def test_a_camera_cannot_look_at_itself(session: Session) -> None:
    here = np.ones(3)
    rig = RigDescription(chain=session.chain, leds=session.leds, stand=Stand(here, np.zeros(3)))
    assert not rig.stand.position.flags.writeable
    with pytest.raises(SessionError, match="looks at its own place"):
        replace(rig.stand, look_at=here)


def test_a_rig_says_where_its_first_eye_to_hand_camera_stands() -> None:
    rig = read_rig(find_rig("ur5"))
    with pytest.raises(SessionError, match="where the first camera stands is not given"):
        replace(rig, stand=None)
    eye_in_hand = read_rig(find_rig("ur5_handeye"))
    assert eye_in_hand.stand is None
    with pytest.raises(SessionError, match="no camera stands"):
        replace(eye_in_hand, stand=rig.stand)


def test_some_of_its_poses_are_a_session(session: Session, tracked: Session) -> None:
    chosen = np.array([0, 2, 3])
    for whole in (session, tracked):
        some, (table,) = whole.at(chosen), whole.measurements
        assert some.poses == tuple(whole.poses[k] for k in chosen)
        np.testing.assert_array_equal(some.q, whole.q[chosen])
        kept = np.isin(table.pose, chosen)
        assert 0 < kept.sum() < len(table)
        np.testing.assert_array_equal(chosen[some.measurements[0].pose], table.pose[kept])
        np.testing.assert_array_equal(some.measurements[0].values, table.values[kept])


def test_tolerances_of_a_mount_need_a_branch_that_it_carries() -> None:
    dual, single = (read_rig(find_rig(name)) for name in ("tiago_dual", "ur5"))
    right = Tolerances(joints={"arm_right_1_joint.mount": {"a": 0.0}})
    assert replace(dual, tolerances=right).tolerances == right
    for rig, label in ((dual, "arm_left_1_joint.mount"), (single, "elbow_joint.mount")):
        with pytest.raises(SessionError, match=f"there is no joint '{label}'"):
            replace(rig, tolerances=Tolerances(joints={label: {"a": 0.0}}))


def test_each_camera_may_have_a_word_of_its_own(session: Session, tmp_path: Path) -> None:
    name = session.rig.names[1]
    one = replace(session, estimate=Estimate("dh", {name: "refine"}, {name: "free"}))
    assert [one.estimate.of("intrinsics", camera) for camera in session.rig.names] == [None, "refine"]
    assert pickle.loads(pickle.dumps(one)).estimate == one.estimate  # noqa: S301 - our own
    write_session(tmp_path / "session", one)
    assert read_session(tmp_path / "session").estimate == one.estimate
