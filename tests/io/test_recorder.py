from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

import urdfcal
from tests.io.making import INTRINSICS, NAMES, RESOLUTION, T_RIGHT_LEFT, URDF, measured, write_points, write_valid
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.recorder import Recorder

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def setup() -> urdfcal.Setup:
    """The hand-written session's robot, LEDs and cameras, from arrays."""
    urdf = urdfcal.Urdf.parse(URDF.encode())
    cameras = tuple(urdfcal.Camera(name, RESOLUTION, np.array(INTRINSICS)) for name in ("left", "right"))
    return urdfcal.Setup(
        chain=urdfcal.Chain.from_urdf(urdf, "tip", "base"),
        leds=(urdfcal.Led("red", [0.05, 0.02, 0.03], 0.005), urdfcal.Led("blue")),
        rig=urdfcal.Rig(cameras, (np.eye(4), T_RIGHT_LEFT)),
        urdf=urdf,
        urdf_reference="arm.urdf",
    )


def same(a: urdfcal.Session, b: urdfcal.Session) -> None:
    assert a.poses == b.poses
    np.testing.assert_array_equal(a.q, b.q)
    assert [table.kind for table in a.measurements] == [table.kind for table in b.measurements]
    for found, table in zip(a.measurements, b.measurements, strict=True):
        for column, values in table.arrays.items():
            np.testing.assert_array_equal(found.arrays[column], values)


def test_what_is_recorded_one_by_one_is_what_is_read_from_files(tmp_path: Path) -> None:
    read = urdfcal.read_session(write_valid(tmp_path / "session"))
    readings, uv = measured()
    recorder = Recorder(setup())
    for k, reading in enumerate(readings):
        # By name from the state of a whole robot, or in order.
        state = dict(zip(("waist", "shoulder", "slide", "roll"), reading, strict=True)) | {"grip": 0.01, "elbow": 9.0}
        pose = recorder.pose(state if k % 2 else reading)
        assert (pose, len(recorder)) == (str(k), k + 1)
    for (k, camera, led), _ in reversed(list(np.ndenumerate(uv[..., 0]))):  # pictures may come late, in any order
        recorder.sighting(str(k), ("left", "right")[camera], NAMES[led], uv[k, camera, led])
    same(recorder.session(), read)


def test_points_one_by_one_are_those_of_the_file(tmp_path: Path) -> None:
    read = urdfcal.read_session(write_points(tmp_path / "session"))
    recorder = Recorder(read)
    for pose, reading in zip(read.poses, read.readings, strict=True):
        recorder.pose(reading, label=pose)
    for k in range(len(read.find(Points))):
        points = read.find(Points)
        recorder.point(read.poses[points.pose[k]], read.led_names[points.led[k]], points.xyz[k], sigma=points.sigma[k])
    same(recorder.session(), read)


@pytest.mark.no_cover
def test_a_recorded_session_calibrates_as_the_measured_one(simulated: Callable) -> None:
    session = simulated("ur5").session
    recorder = Recorder(session)
    for k, reading in enumerate(session.readings):
        recorder.pose(reading, label=session.poses[k], time=float(k))
    seen = session.find(Detections)
    for row in range(len(seen)):
        names = session.poses[seen.pose[row]], session.rig.names[seen.camera[row]], session.led_names[seen.led[row]]
        recorder.sighting(*names, seen.uv[row])
    recorded = recorder.session()
    np.testing.assert_array_equal(recorded.time, np.arange(len(session.poses)))
    assert recorded.sha256 == {}
    documents = [urdfcal.calibrate(measured).to_dict() for measured in (recorded, session)]
    for document in documents:
        document.pop("provenance")
    assert documents[0] == documents[1]


def test_recording_goes_on_and_sessions_stay(simulated: Callable) -> None:
    session = simulated("elbow3r").session
    recorder = Recorder(session)
    sizes = []
    for k, reading in enumerate(session.readings[:6]):
        pose = recorder.pose(reading)
        recorder.sighting(pose, "cam0", "led", [100.0 + k, 100.0])
        if k >= 2:
            sizes.append(recorder.session())
    assert [len(made.poses) for made in sizes] == [3, 4, 5, 6]


READING = [0.1, 0.2, 0.1, 0.0]


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (lambda r: r.pose(READING, label="0"), "pose '0': there is a pose of this label"),
        (lambda r: r.pose(READING, label=" "), "an empty name"),
        (lambda r: r.pose([0.1, 0.2]), r"pose '1': joints has shape \(2,\), not \(4,\)"),
        (lambda r: r.pose([0.1, np.nan, 0.1, 0.0]), "not finite"),
        (lambda r: r.pose(["a", 0.2, 0.1, 0.0]), "not made of numbers"),
        (lambda r: r.pose([45.0, 0.2, 0.1, 0.0]), r"waist = 45 rad is outside the joint's limits \[-2.9, 2.9\]"),
        (lambda r: r.pose({"waist": 0.1, "shoulder": 0.1, "slide": 0.1}), "no reading of roll"),
        (lambda r: r.pose({"waste": 0.1}), "no joint 'waste'.*Did you mean 'waist'"),
        (lambda r: r.pose(READING, time=1.0), "it has a time, and others have none"),
        (lambda r: r.pose(READING, torques=READING), "it has torques, and others have none"),
        (lambda r: r.sighting("7", "left", "red", [10, 10]), "'7' is none of the poses"),
        (lambda r: r.sighting("0", "Left", "red", [10, 10]), "'Left' is none of the cameras.*Did you mean 'left'"),
        (lambda r: r.sighting("0", "left", "green", [10, 10]), "'green' is none of the LEDs"),
        (lambda r: r.sighting("0", "left", "blue", [10, 1100]), r"\(10, 1100\) is outside the 1280 x 1024 image"),
        (lambda r: r.sighting("0", "left", "blue", [10, np.nan]), "not finite"),
        (lambda r: r.sighting("0", "left", "blue", [10, 10, 1]), r"uv has shape \(3,\)"),
        (lambda r: r.sighting("0", "left", "blue", [10, 10], sigma=0.0), "sigma is 0; it must be positive"),
        (lambda r: r.sighting("0", "left", "red", [11, 10]), "it was seen there already"),
        (lambda r: r.point("0", "red", [0, 0, np.inf]), "not finite"),
        (lambda r: r.point("0", "red", [0, 0]), r"xyz has shape \(2,\)"),
        (lambda r: r.session(), "1 poses are too few"),
    ],
)
def test_what_makes_no_sense_is_refused_at_once_and_changes_nothing(add: Callable, message: str) -> None:
    recorder = Recorder(setup())
    recorder.pose(READING)
    recorder.sighting("0", "left", "red", [10.0, 10.0])
    with pytest.raises(SessionError, match=message):
        add(recorder)
    assert len(recorder) == 1
    for label in ("a", "b"):
        recorder.pose(READING, label=label)
    session = recorder.session()
    assert (session.poses, session.time, session.find(Points)) == (("0", "a", "b"), None, None)
    assert session.find(Detections).uv.tolist() == [[10.0, 10.0]]


def test_sightings_need_cameras() -> None:
    with_cameras = setup()
    recorder = Recorder(urdfcal.Setup(chain=with_cameras.chain, leds=with_cameras.leds))
    recorder.pose(READING)
    with pytest.raises(SessionError, match="no cameras"):
        recorder.sighting("0", "left", "red", [1, 1])


def test_torques_are_recorded_with_their_poses_by_name_or_in_order() -> None:
    recorder = Recorder(setup())
    readings, uv = measured()
    by_name = {"waist": 1.0, "shoulder": -2.0, "slide": 30.0, "roll": 0.5, "grip": 9.0}
    for k, reading in enumerate(readings):
        recorder.pose(reading, torques=by_name if k % 2 else [0.0, 0.1, 0.2, k])
        if k != 2:  # nothing was seen there: it tells where the arm came from
            recorder.sighting(str(k), "left", "red", uv[k, 0, 0])
    with pytest.raises(SessionError, match="it has no torques, and others have"):
        recorder.pose(readings[0])
    with pytest.raises(SessionError, match="torques has values that are not finite"):
        recorder.pose(readings[0], torques=[np.nan, 0.0, 0.0, 0.0])
    session = recorder.session()
    assert len(recorder) == len(session.poses)
    np.testing.assert_array_equal(session.chain.readings(session.torques)[2], [0.0, 0.1, 0.2, 2.0])
    np.testing.assert_array_equal(session.chain.readings(session.torques)[3], [1.0, -2.0, 30.0, 0.5])
    np.testing.assert_array_equal(session.came_from[3], session.q[2])
