"""What moved in a session is something else from then on."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.session.exclusion import leave_out
from urdfcal.session.knowledge import Estimate, Excluded
from urdfcal.session.moves import resolve_moves, session_name
from urdfcal.simulation.motion import MotionSettings, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session


@pytest.fixture
def session(simulated: Callable) -> Session:
    return simulated("panda", poses=12).session


def moved(session: Session, **what: tuple[int, ...]) -> Session:
    return replace(session, moved={name: tuple(session.poses[k] for k in poses) for name, poses in what.items()})


def test_without_a_move_it_is_the_same(session: Session) -> None:
    assert resolve_moves(session) is session


def test_the_base_moves_into_another_part(session: Session) -> None:
    found = resolve_moves(moved(session, base=(8, 3)))
    assert found.parts == ("", f"base@{session.poses[3]}", f"base@{session.poses[8]}")
    assert found.part.tolist() == [0] * 3 + [1] * 5 + [2] * 4
    assert found.at(np.array([2, 3, 9])).part.tolist() == [0, 1, 2]
    assert not found.moved
    assert [session_name(part) for part in (*found.parts, "a/base@3", "a/b")] == ["", "", "", "a", "a/b"]


def test_an_led_that_slipped_is_another_one_of_unknown_place(session: Session) -> None:
    (led,) = session.led_names
    found = resolve_moves(moved(session, **{led: (3, 8)}))
    assert found.led_names == (led, f"{led}@{session.poses[3]}", f"{led}@{session.poses[8]}")
    assert [other.position for other in found.leds[1:]] == [None, None]
    table = found.find(Detections)
    assert np.array_equal(table.led, np.searchsorted([3, 8], table.pose, side="right"))
    assert np.array_equal(table.uv, session.find(Detections).uv)
    assert found.parts == ("",)


def test_a_bumped_camera_is_elsewhere_with_the_same_lens(session: Session) -> None:
    left, right = session.rig.names
    said = Estimate(extrinsics="fixed")
    found = resolve_moves(moved(replace(session, estimate=said), **{right: (5,)}))
    assert found.rig.names == (left, right, f"{right}@{session.poses[5]}")
    assert found.rig.lens == (0, 1, 1)
    assert found.rig.T_cam_world[2] is None
    assert found.attachments.reference.tolist() == [0, 0, 0]
    assert found.attachments.worlds.tolist() == [0]
    assert found.estimate.extrinsics == {left: "fixed", right: "fixed"}
    table, before = found.find(Detections), session.find(Detections)
    rows = np.lexsort([before.camera, before.pose])
    assert np.array_equal(table.camera, np.where((before.camera == 1) & (before.pose >= 5), 2, before.camera)[rows])


def test_a_camera_on_a_link_stays_there(simulated: Callable) -> None:
    session = simulated("ur5_handeye", poses=12).session
    (camera,) = session.rig.names
    found = resolve_moves(moved(session, **{camera: (5,)}))
    assert [mount.link for mount in found.mounts] == [session.mounts[0].link] * 2
    assert found.attachments.T_cam_frame[1] is None


def test_frames_of_a_moving_arm_go_with_their_camera(simulated: Callable) -> None:
    session = set_in_motion(simulated("ur5", poses=8), MotionSettings(frame_rate=1.0, joint_rate=20.0)).session
    camera = session.rig.names[1]
    mine = np.flatnonzero(session.motion.camera == 1)
    found = resolve_moves(moved(session, **{camera: (int(mine[4]),)}))
    assert np.array_equal(np.flatnonzero(found.motion.camera == 2), mine[4:])
    assert [found.label(k) for k in mine] == [session.label(k) for k in mine]


@pytest.mark.parametrize(
    ("what", "label", "message"),
    [
        ("led2", "03", "moved: there is no base, LED or camera 'led2'.*The base, LED or cameras are: base, led, "),
        ("led", "99", r"moved\.led: there is no pose '99'"),
        ("base", "01", r"moved\.base: '01' is the first pose of all\. Name the first pose that was measured after"),
    ],
)
def test_moves_of_nothing_are_refused(what: str, label: str, message: str, session: Session) -> None:
    with pytest.raises(SessionError, match=message):
        replace(session, moved={what: (label,)})


def test_of_base_and_cameras_one_must_stay(session: Session) -> None:
    left, right = session.rig.names
    with pytest.raises(SessionError, match=r"moved: the base and all cameras moved before '03'\. Leave one camera out"):
        moved(session, **{"base": (2, 5), left: (2,), right: (2, 5)})
    assert moved(session, **{"base": (2,), left: (3,), right: (2,)}).moved


def test_a_move_that_is_said_twice_is_one(session: Session) -> None:
    assert resolve_moves(moved(session, base=(3, 3))).parts == ("", f"base@{session.poses[3]}")


def test_moves_are_before_the_next_pose_that_is_left(session: Session) -> None:
    some = moved(session, base=(3, 4, 8, 11), led=(2,)).at(np.array([2, 5, 6, 7, 9]))
    assert some.moved == {"base": (session.poses[5], session.poses[9])}
    rest = leave_out(moved(session, base=(3,), led=(2,)), Excluded(poses=session.poses[3:5]))
    assert rest.moved == {"base": (session.poses[5],), "led": (session.poses[2],)}
    gone = leave_out(moved(session, **{session.rig.names[1]: (2,)}), Excluded(cameras=(session.rig.names[1],)))
    assert gone.moved == {}
