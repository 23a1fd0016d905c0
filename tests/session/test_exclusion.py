"""What a session leaves out: names and ranges of them, what goes with it, and what stays because it is of use."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io.making import write_valid
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_session
from urdfcal.session.attachments import CameraMount
from urdfcal.session.exclusion import in_words, labels, leave_out, restored, summary
from urdfcal.session.knowledge import Estimate, Excluded, LedDistance, Noise

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.session.model import Session

KNOWN = ("0", "1", "2", "10", "a-b", "c", "007")


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return read_session(write_valid(tmp_path / "session"))


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("1", ("1",)),
        ("1-10", ("1", "2", "10")),
        ("1 - 2", ("1", "2")),
        ("c-c", ("c",)),
        ("a-b", ("a-b",)),
        ("2-a-b", ("2", "10", "a-b")),
        ("a-b-c", ("a-b", "c")),
        ("007", ("007",)),
    ],
)
def test_a_range_is_of_poses_as_they_come(said: str, meant: tuple[str, ...]) -> None:
    assert labels(said, KNOWN, "here") == meant


def test_what_is_no_label_is_refused() -> None:
    with pytest.raises(SessionError, match=r"here: there is no pose '3'\. "):
        labels("3", KNOWN, "here")
    with pytest.raises(SessionError, match="there is no pose '11'"):
        labels("1-11", KNOWN, "here")
    with pytest.raises(SessionError, match=r"there is no pose '1.0'\. Did you mean '1'\? Labels are text"):
        labels("1.0", KNOWN, "here")
    with pytest.raises(SessionError, match=r"here: pose '1' comes before '10'\. Write 1-10"):
        labels("10-1", KNOWN, "here")


def test_what_to_write_is_what_is_read() -> None:
    assert in_words("exclude", "poses", ["30", "31", "49"]) == "exclude: {poses: [30-49]}"
    assert in_words("exclude", "poses", ["30"]) == "exclude: {poses: [30]}"
    assert in_words("exclude", "poses", ["a: b", "#7"]) == 'exclude: {poses: ["a: b-#7"]}'
    assert in_words("moved", "LED: a", ["7"]) == 'moved: {"LED: a": [7]}'


def test_a_summary_counts_poses_and_names_the_rest() -> None:
    assert summary({}) == ""
    assert summary({"poses": ["1"]}) == "1 pose excluded"
    assert summary({"poses": ["1", "2", "3"], "cameras": ["left"], "leds": ["red"]}) == (
        "3 poses, camera 'left', LED 'red' excluded"
    )


def test_poses_go_with_their_measurements(session: Session) -> None:
    left = leave_out(session, Excluded(poses=("2", "5")))
    assert left.poses == ("0", "1", "3", "4", "6", "7")
    assert np.array_equal(left.q, session.q[[0, 1, 3, 4, 6, 7]])
    table, whole = left.find(Detections), session.find(Detections)
    assert np.array_equal(table.uv, whole.uv[~np.isin(whole.pose, [2, 5])])
    assert table.pose.max() == 5
    assert left.excluded.whole is session


def test_a_pose_that_was_only_seen_by_what_is_left_out_goes(session: Session) -> None:
    table = session.find(Detections)
    alone = replace(session, measurements=(table.rows((table.pose != 3) | (table.camera == 1)),))
    left = leave_out(alone, Excluded(cameras=("right",)))
    assert left.poses == ("0", "1", "2", "4", "5", "6", "7")


def test_a_pose_that_never_had_a_measurement_is_none_of_its_business(session: Session) -> None:
    table = session.find(Detections)
    blind = replace(session, measurements=(table.rows(table.pose != 3),))
    assert "3" in leave_out(blind, Excluded(poses=("5",))).poses


def test_a_camera_goes_from_the_rig_and_all_that_is_said_of_it(session: Session) -> None:
    said = replace(session, estimate=Estimate(intrinsics={"left": "free", "right": "fixed"}))
    left = leave_out(said, Excluded(cameras=("right",)))
    assert left.rig.names == ("left",)
    assert dict(left.estimate.intrinsics) == {"left": "free"}
    assert set(left.find(Detections).camera) == {0}


def test_the_first_camera_stays_where_others_are_placed_by_it(session: Session) -> None:
    left = leave_out(session, Excluded(cameras=("left",)))
    assert left.rig.names == ("left", "right")
    assert set(left.find(Detections).camera) == {1}
    unplaced = replace(session, rig=Rig(session.rig.cameras, (np.eye(4), None)))
    left = leave_out(unplaced, Excluded(cameras=("left",)))
    assert left.rig.names == ("right",)
    assert np.array_equal(left.rig.T_cam_world[0], np.eye(4))
    assert set(left.find(Detections).camera) == {0}


def test_a_camera_on_a_link_goes_with_its_mount(session: Session) -> None:
    rig = Rig(session.rig.cameras, (np.eye(4), None))
    mounted = replace(session, rig=rig, mounts=(CameraMount("right", "tip"),))
    left = leave_out(mounted, Excluded(cameras=("right",)))
    assert left.mounts == ()


def test_an_led_stays_where_a_distance_ends_at_it(session: Session) -> None:
    left = leave_out(session, Excluded(leds=("red",)))
    assert left.led_names == ("blue",)
    assert set(left.find(Detections).led) == {0}
    bar = replace(session, led_distances=(LedDistance(("red", "blue"), 0.1, 1e-4),))
    left = leave_out(bar, Excluded(leds=("red",)))
    assert left.led_names == ("red", "blue")
    assert set(left.find(Detections).led) == {1}


def test_too_little_is_refused(session: Session) -> None:
    with pytest.raises(SessionError, match="exclude: it leaves nothing that was measured"):
        leave_out(session, Excluded(leds=("red", "blue")))
    with pytest.raises(SessionError, match="exclude: it leaves 2 poses, which are too few"):
        leave_out(session, Excluded(poses=tuple("012345")))


def test_correlations_of_the_cameras_that_stay_stay(session: Session) -> None:
    rng = np.random.default_rng(0)
    cameras = (*session.rig.cameras, replace(session.rig.cameras[1], name="third"))
    places = (*session.rig.T_cam_world, session.rig.T_cam_world[1])
    A = rng.normal(size=(24, 24))
    covariance = A @ A.T + 24 * np.eye(24)
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    sizes, sigmas, start = (4, 10, 10), [], 0
    for size in sizes:
        end = start + size
        own = sigma[start:end]
        symmetric = correlation[start:end, :end].copy()
        np.fill_diagonal(symmetric[:, start:], 1.0)
        sigmas.append(CameraSigma(own[:4], own[4:] if size > 4 else None, symmetric))
        start = end
    rig = Rig(cameras, places, tuple(sigmas)).at(np.array([0, 2]))
    assert rig.names == ("left", "third")
    kept = [*range(4), *range(14, 24)]
    np.testing.assert_allclose(rig.correlation, correlation[np.ix_(kept, kept)], atol=1e-12)


def test_what_was_left_out_is_restored_and_settings_are_the_sessions_own(session: Session) -> None:
    left = leave_out(session, Excluded(poses=("2",), leds=("red",)))
    again = restored(replace(left, noise=Noise(pixel=0.3)))
    assert again.poses == session.poses
    assert again.find(Detections) is session.find(Detections)
    assert again.noise.pixel == 0.3
    assert again.excluded.named == {"poses": ["2"], "leds": ["red"]}
    assert restored(session) is session


def test_of_what_was_changed_since_only_the_rest_is_known(session: Session) -> None:
    left = leave_out(session, Excluded(poses=("2",)))
    table = left.find(Detections)
    changed = restored(replace(left, measurements=(replace(table, uv=table.uv + 1.0),)))
    assert len(changed.poses) == len(left.poses)
    assert changed.excluded.named == {}
    assert len(restored(left.at(np.arange(5))).poses) == 5
