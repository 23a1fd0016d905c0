"""What stands around the arm: the key ``scene`` of rig.yaml and session.yaml, or a file of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from urdfcal.io.keys import Keys, Name, Vector
from urdfcal.io.yaml_document import Document
from urdfcal.session.obstacle import Obstacle

if TYPE_CHECKING:
    from pathlib import Path


class ObstacleKeys(Keys):
    """A box: its size, the place of its middle in the base link's frame, in m, and how it is turned, in rad."""

    size: Vector
    position: Vector
    rpy: Vector = Field(default=[0.0, 0.0, 0.0])


class SceneFile(Keys):
    """A file of boxes alone."""

    scene: dict[Name, ObstacleKeys]


def obstacles(keys: dict[str, ObstacleKeys]) -> tuple[Obstacle, ...]:
    """Return the boxes that are named.

    Raises:
        SessionError: a size is not positive.
    """
    return tuple(Obstacle(name, **dict(box)) for name, box in keys.items())


def read_scene(path: Path) -> tuple[Obstacle, ...]:
    """Read a file of boxes: its key ``scene``.

    Raises:
        SessionError: it cannot be read or is malformed, with line and column.
    """
    document = Document.read(path)
    with document.placing():
        return obstacles(document.validate(SceneFile).scene)
