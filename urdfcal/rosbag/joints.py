"""Joint readings from sensor_msgs/JointState: messages that have all joints of the arm, each by its name."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import SessionError
from urdfcal.names import listed
from urdfcal.rosbag.clock import timeline

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.rosbag.bag import Message
    from urdfcal.rosbag.clock import Timeline


@dataclass(frozen=True, eq=False)
class JointStates:
    """The readings of an arm's joints.

    Attributes:
        times: when each was taken, and which messages were left out.
        readings: (K, k) of the joints asked for, in their order. [rad or m]
    """

    times: Timeline
    readings: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "readings", frozen(self.readings))


def read_joint_states(topic: str, messages: Iterable[Message], joints: Sequence[str]) -> JointStates:
    """Read the positions of some joints.

    Messages with none of them are another device's, and those without positions are of no use: they are left out.

    Args:
        topic: its name.
        messages: of the topic, in the order in which they were recorded.
        joints: names of those that every reading has.

    Raises:
        SessionError: no message has all joints, or one contradicts itself.
    """
    needed = set(joints)
    stamps, received, rows = [], [], []
    # Messages that cannot be used: by the joints that they have, and by the joint that is not a number.
    parts: Counter[frozenset[str]] = Counter()
    undefined: Counter[str] = Counter()
    seen: dict[str, None] = {}
    empty = 0
    for number, message in enumerate(messages, 1):
        names, positions = message.content.name, message.content.position
        seen |= dict.fromkeys(names)
        if not needed.intersection(names):
            continue
        if not len(positions):
            empty += 1
            continue
        if len(positions) != len(names):
            raise SessionError(f"message {number} has {len(names)} names and {len(positions)} positions", where=topic)
        if len(set(names)) < len(names):
            raise SessionError(f"message {number} names a joint twice: {listed(names)}", where=topic)
        value = dict(zip(names, positions.tolist(), strict=True))
        if not needed <= value.keys():
            parts[frozenset(needed & value.keys())] += 1
            continue
        row = [value[name] for name in joints]
        bad = [name for name, x in zip(joints, row, strict=True) if not np.isfinite(x)]
        if bad:
            undefined.update(bad[:1])
            continue
        stamps.append(message.stamp)
        received.append(message.received)
        rows.append(row)
    warnings = []
    if empty:
        warnings.append(f"{topic}: {empty} messages have no positions and are left out")
    if undefined:
        warnings.append(
            f"{topic}: {undefined.total()} messages are left out, in which the position of {listed(undefined)} "
            "is no finite number"
        )
    if not rows:
        raise _unusable(topic, joints, list(seen), parts, warnings)
    if parts:
        warnings.append(f"{topic}: {parts.total()} messages have only some of the joints and are left out")
    times = timeline(topic, stamps, received, warnings)
    return JointStates(times, np.array(rows)[times.kept])


def _unusable(
    topic: str, joints: Sequence[str], seen: Sequence[str], parts: Counter[frozenset[str]], warnings: Sequence[str]
) -> SessionError:
    """Say why no message can be used."""
    missing = [name for name in joints if name not in seen]
    if missing:
        return SessionError(
            f"no joint state has {listed(missing)}",
            where=topic,
            remedy=f"The joints in it are: {listed(seen)}. Other names? Another URDF, --base or --tip, or --joints.",
        )
    if parts:
        sets = "; ".join(f"{listed(sorted(names))} ({count} messages)" for names, count in parts.most_common(4))
        return SessionError(
            f"no message has all joints of the arm: {sets}",
            where=topic,
            remedy="Record a topic on which one node publishes them together.",
        )
    return SessionError(
        "no message can be used", where=topic, remedy=" ".join(f"{w.removeprefix(f'{topic}: ')}." for w in warnings)
    )
