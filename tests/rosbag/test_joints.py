from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.rosbag.bags import START, Recording
from urdfcal.errors import SessionError
from urdfcal.rosbag.bag import Message
from urdfcal.rosbag.importing import read_joint_states

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.rosbag.clock import Timeline

JOINTS = ("a", "b", "c")
PERIOD = 8_000_000


def read(*said: tuple[Sequence[str], Sequence[float]]) -> tuple[Timeline, np.ndarray]:
    """Read messages of names and positions, one each period."""
    bag = Recording("sqlite3")
    for i, (names, positions) in enumerate(said):
        bag.joints(START + PERIOD * i, positions, names)
    messages = [Message(topic, received, content) for received, topic, content in bag.messages]
    return read_joint_states("/joint_states", messages, JOINTS)


def test_every_joint_is_read_by_its_name() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(20, 5))
    said = []
    for row in values:
        order = rng.permutation(5)
        said.append(([("a", "b", "c", "grip", "lift")[i] for i in order], row[order]))
    times, readings = read(*said)
    np.testing.assert_array_equal(readings, values[:, :3])
    np.testing.assert_array_equal(times.time, START + PERIOD * np.arange(20))
    assert times.warnings == ()


def test_another_devices_messages_on_the_same_topic_do_not_matter() -> None:
    times, readings = read(("abc", [1, 2, 3]), (["grip"], [0.5]), ("cba", [6, 5, 4]), (["grip"], [0.6]))
    np.testing.assert_array_equal(readings, [[1, 2, 3], [4, 5, 6]])
    assert times.warnings == ()


def test_messages_of_no_use_are_left_out_and_counted() -> None:
    nan = float("nan")
    times, readings = read(("abc", [1, 2, 3]), ("abc", []), ("abc", [1, nan, nan]), ("ab", [1, 2]), ("abc", [4, 5, 6]))
    np.testing.assert_array_equal(readings, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(times.time, [START, START + 4 * PERIOD])
    assert times.warnings == (
        "/joint_states: 1 messages have no positions and are left out",
        "/joint_states: 1 messages are left out, in which the position of b is no finite number",
        "/joint_states: 1 messages have only some of the joints and are left out",
    )


def test_a_joint_of_another_device_may_be_no_number() -> None:
    assert read(("abcd", [1, 2, 3, float("nan")]))[0].warnings == ()


def test_readings_follow_the_order_of_their_stamps() -> None:
    bag = Recording("sqlite3")
    for i in (0, 2, 1, 2, 3):
        bag.joints(START + PERIOD * i, [i, i, i], JOINTS)
    messages = [Message(topic, received, content) for received, topic, content in bag.messages]
    times, readings = read_joint_states("/joint_states", messages, JOINTS)
    np.testing.assert_array_equal(readings[:, 0], [0, 1, 2, 3])
    assert len(times.warnings) == 2


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: read(("ab", [1, 2]), ("xb", [1, 2])), r"no joint state has c\. The joints in it are: a, b, x\."),
        (lambda: read(), "no joint state has a, b, c"),
        (
            lambda: read(("ab", [1, 2]), ("c", [3])),
            r"all joints of the arm: a, b \(1 messages\); c \(1 messages\)",
        ),
        (lambda: read(("abc", []), ("abc", [])), "no message can be used. 2 messages have no positions"),
        (lambda: read(("abc", [1, 2, float("inf")])), "the position of c is no finite number"),
        (lambda: read(("abc", [1, 2, 3]), ("abc", [1, 2])), "message 2 has 3 names and 2 positions"),
        (lambda: read(("aabc", [1, 2, 3, 4])), "message 1 names a joint twice: a, a, b, c"),
    ],
)
def test_what_cannot_be_used_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(SessionError, match=message):
        call()
