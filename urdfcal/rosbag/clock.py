"""Times of messages: their stamps in order, and the clocks of their senders aligned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Ints, frozen
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Sequence

_NANO = 1_000_000_000
# Networks reorder messages by milliseconds; a clock that is set back, or a simulation that starts anew, by seconds.
_REORDERED = 1 * _NANO


@dataclass(frozen=True, eq=False)
class Timeline:
    """The times at which the messages of one topic were measured.

    Attributes:
        topic: its name.
        kept: (K,) indices of the messages that have a time of their own, in the order of these times.
        time: (K,) strictly increasing, on the sender's clock. [ns]
        delay: from a message's time to its arrival, the shortest. [ns]
        warnings: which messages were left out or reordered, and which clock was changed.
    """

    topic: str
    kept: Ints
    time: Ints
    delay: int
    warnings: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "kept", frozen(self.kept, np.intp))
        object.__setattr__(self, "time", frozen(self.time, np.int64))


def timeline(topic: str, stamps: Sequence[int], received: Sequence[int], left_out: Sequence[str] = ()) -> Timeline:
    """Put messages in the order of their stamps.

    Messages without a stamp among others that have one, and those that repeat one, are left out. Where none has one,
    the times at which they were received are used instead.

    Args:
        topic: whose messages these are.
        stamps: of the messages, in the order in which they were recorded; 0 where there is none. [ns]
        received: when they were recorded. [ns]
        left_out: warnings of messages that are not among them.

    Raises:
        SessionError: there is no message, or the sender's clock was set back.
    """
    if not len(stamps):
        raise SessionError("there are no messages", where=topic)
    time, arrival = np.array(stamps, np.int64), np.array(received, np.int64)
    warnings = list(left_out)
    blank = time == 0
    if blank.all():
        time, blank = arrival, np.zeros(len(time), dtype=bool)
        warnings.append(f"{topic}: no message has a stamp; the times at which they were recorded are used")
    elif blank.any():
        warnings.append(f"{topic}: {np.count_nonzero(blank)} messages without a stamp are left out")
    kept = np.flatnonzero(~blank)
    back = np.maximum.accumulate(time[kept]) - time[kept]
    if back.max() > _REORDERED:
        number = int(kept[np.argmax(back > _REORDERED)])
        raise SessionError(
            f"the stamp of message {number + 1} is {back.max() / _NANO:.3f} s before an earlier one's",
            where=topic,
            remedy="The sender's clock was set back, or it started anew: record again, or cut the bag there.",
        )
    if back.any():
        warnings.append(f"{topic}: {np.count_nonzero(back)} messages came late and are put in order")
    kept = kept[np.argsort(time[kept], kind="stable")]
    repeated = np.diff(time[kept], prepend=time[kept[0]] - 1) == 0
    if repeated.any():
        warnings.append(f"{topic}: {np.count_nonzero(repeated)} messages repeat another one's stamp and are left out")
        kept = kept[~repeated]
    delay = int((arrival[kept] - time[kept]).min())
    return Timeline(topic, kept, time[kept], delay, tuple(warnings))


def align_clock(robot: Timeline, camera: Timeline) -> Timeline:
    """Return a camera's times, on the robot's clock if its own has nothing in common with that one.

    Cameras often count from when they were switched on. A constant difference does not matter, since it is estimated,
    but it must be small: then the shortest delays of both on their way to the recorder are taken for the same.

    Raises:
        SessionError: robot and camera were not recorded at the same time.
    """
    if _overlap(robot, camera):
        return camera
    shift = camera.delay - robot.delay
    warning = (
        f"{camera.topic}: its clock differs from that of {robot.topic}; {shift / _NANO:.9f} s are added to its stamps, "
        "by the times at which the messages were recorded"
    )
    moved = Timeline(camera.topic, camera.kept, camera.time + shift, robot.delay, (*camera.warnings, warning))
    if not _overlap(robot, moved):
        raise SessionError(
            f"its images were not recorded at the same time as the joint states of {robot.topic}",
            where=camera.topic,
            remedy="Record both together.",
        )
    return moved


def _overlap(a: Timeline, b: Timeline) -> bool:
    return bool(a.time[0] <= b.time[-1] and b.time[0] <= a.time[-1])
