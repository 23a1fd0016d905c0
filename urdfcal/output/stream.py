"""Columns of poses into a rerun stream."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from urdfcal.rotations import matrix_to_quaternion

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from rerun import AsComponents, RecordingStream
    from rerun.blueprint.api import BlueprintLike

    from urdfcal.arrays import Floats, Ints

POSE, TIME = "pose", "time"
ITERATION = "iteration"
CORNER = 0.5
"""What is added to pixels: rerun's (0, 0) is the corner of the top-left pixel, ours is its centre."""


@contextmanager
def recorded(path: Path, layout: BlueprintLike, name: str) -> Iterator[RecordingStream]:
    """Yield a stream that goes into a file with its layout of views, and is ended with the block."""
    stream = rr.RecordingStream("urdfcal")
    try:
        stream.save(path, default_blueprint=layout)
        stream.send_recording_name(name)
        yield stream
    finally:
        stream.disconnect()


@dataclass(frozen=True)
class Layer:
    """A branch of the entity tree and the poses its entities live at.

    Attributes:
        stream: where everything goes.
        path: of the branch.
        poses: N, number of poses; on their timeline they are counted from 1, as people count.
        time: (N,) of each pose, if known. [s]
    """

    stream: RecordingStream
    path: str
    poses: int
    time: Floats | None = None

    def at(self, *names: str) -> Layer:
        """Go down the tree; names are taken literally, whatever characters they have."""
        return Layer(self.stream, "/".join([self.path, *map(rr.escape_entity_path_part, names)]), self.poses, self.time)

    def fixed(self, *what: AsComponents) -> None:
        """Log what is the same at all poses."""
        self.stream.log(self.path, *what, static=True)

    def each(self, kind: Any, columns: Mapping[str, Any], pose: Ints | None = None, **same: Any) -> None:
        """Log one row a pose.

        Args:
            kind: what rerun calls it.
            columns: its components, an instance each.
            pose: (M,) ascending, of each instance; without, each pose has one.
            same: components that are the same at all poses.
        """
        if same:
            self.fixed(kind.from_fields(**same))
        found = kind.columns(**columns)
        if pose is not None:
            found = found.partition(np.bincount(pose, minlength=self.poses))
        rows = [rr.TimeColumn(POSE, sequence=np.arange(1, self.poses + 1))]
        if self.time is not None:
            rows.append(rr.TimeColumn(TIME, duration=self.time))
        rr.send_columns(self.path, rows, found, recording=self.stream)

    def placed(self, T: Floats, *, moves: bool = True) -> None:
        """Place the branch in its parent at every pose, (N, 4, 4), or where it does not move at the first for all."""
        if moves:
            columns = {"translation": T[:, :3, 3], "quaternion": matrix_to_quaternion(T[:, :3, :3])}
            self.each(rr.Transform3D, columns)
        else:
            self.fixed(placed(T[0]))


def placed(T: Floats, scale: tuple[float, ...] = (1.0, 1.0, 1.0)) -> rr.Transform3D:
    """A transform that does not change, (4, 4)."""
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3] * scale)
