from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from urdfcal.errors import SessionError
from urdfcal.rosbag.clock import Timeline, align_clock, timeline

DAY = 1_700_000_123_987_654_321
MS, S = 10**6, 10**9


def made(first: int, last: int, delay: int = 0) -> Timeline:
    stamps = np.linspace(first, last, 50).astype(np.int64)
    return timeline("/t", stamps.tolist(), (stamps + delay).tolist())


@given(st.lists(st.integers(0, 900 * MS), min_size=1, max_size=40))
def test_times_are_the_stamps_in_order_each_once(offsets: list[int]) -> None:
    stamps = [DAY + offset for offset in offsets]
    result = timeline("/t", stamps, [DAY + 5 * S + i for i in range(len(stamps))])
    assert result.time.tolist() == sorted(set(stamps))
    # Of equal ones the first.
    assert [stamps[i] for i in result.kept] == result.time.tolist()
    assert all(stamps.index(stamps[i]) == i for i in result.kept)
    assert bool(result.warnings) == (stamps != sorted(set(stamps)))


def test_what_was_done_is_said() -> None:
    stamps = [DAY, 0, DAY + 20, DAY + 10, DAY + 20, 0]
    result = timeline("/t", stamps, [DAY + i for i in range(6)])
    assert result.kept.tolist() == [0, 3, 2]
    assert result.warnings == (
        "/t: 2 messages without a stamp are left out",
        "/t: 1 messages came late and are put in order",
        "/t: 1 messages repeat another one's stamp and are left out",
    )


def test_without_any_stamp_the_times_of_arrival_stand_in() -> None:
    received = [DAY + 30, DAY + 60, DAY + 90]
    result = timeline("/t", [0, 0, 0], received)
    assert result.time.tolist() == received
    assert "no message has a stamp" in result.warnings[0]


def test_a_clock_that_was_set_back_is_refused() -> None:
    stamps = [DAY, DAY + S, DAY + 2 * S, DAY + S - 1, DAY + S]
    with pytest.raises(SessionError, match=r"/t: the stamp of message 4 is 1\.000 s before an earlier one's"):
        timeline("/t", stamps, stamps)
    assert len(timeline("/t", [*stamps[:3], DAY + S], stamps[:4]).time) == 3  # 1 s late is late and no more
    with pytest.raises(SessionError, match="there are no messages"):
        timeline("/t", [], [])


def test_clocks_that_agree_are_left_alone() -> None:
    robot, camera = made(DAY, DAY + 10 * S), made(DAY + 9 * S, DAY + 30 * S, delay=50 * MS)
    assert align_clock(robot, camera) is camera


def test_clocks_agree_if_their_times_touch() -> None:
    robot = made(DAY, DAY + 10 * S)
    for first, last in ((DAY + 10 * S, DAY + 20 * S), (DAY - 10 * S, DAY)):
        camera = made(first, last, delay=50 * MS)
        assert align_clock(robot, camera) is camera


def test_a_camera_that_counts_from_when_it_was_switched_on_gets_the_robots_clock() -> None:
    robot = made(DAY, DAY + 10 * S, delay=2 * MS)
    # Its stamps are 10 s at the robot's DAY; images take 30 ms to the recorder.
    camera = made(10 * S, 20 * S, delay=DAY - 10 * S + 30 * MS)
    moved = align_clock(robot, camera)
    np.testing.assert_array_equal(np.diff(moved.time), np.diff(camera.time))
    assert moved.time[0] == DAY + 28 * MS
    assert f"its clock differs from that of /t; {(DAY - 10 * S + 28 * MS) / S:.9f} s are added" in moved.warnings[-1]


def test_what_was_not_recorded_together_is_refused() -> None:
    robot, camera = made(DAY, DAY + 10 * S), made(DAY + 20 * S, DAY + 30 * S)
    with pytest.raises(SessionError, match="not recorded at the same time"):
        align_clock(robot, camera)
