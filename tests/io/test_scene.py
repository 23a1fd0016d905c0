from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.errors import SessionError
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.scene import read_scene
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.writing import write_session
from urdfcal.session.obstacle import Obstacle

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

WALL = "scene: {wall: {size: [0.1, 2, 1], position: [0.6, 0, 0.5], rpy: [0, 0, 1.5707963]}}\n"


def test_a_scene_is_a_file_or_a_key_of_a_rig(tmp_path: Path) -> None:
    (tmp_path / "boxes.yaml").write_text(WALL)
    (wall,) = read_scene(tmp_path / "boxes.yaml")
    assert wall.name == "wall"
    np.testing.assert_allclose(wall.T_base_box @ [0, 1, 0, 1], [-0.4, 0, 0.5, 1], atol=1e-6)
    for file in find_rig("elbow3r").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    assert read_rig(tmp_path).scene == ()
    with (tmp_path / "rig.yaml").open("a") as rig:
        rig.write(WALL)
    (same,) = read_rig(tmp_path).scene
    np.testing.assert_array_equal(same.T_base_box, wall.T_base_box)


def test_a_session_is_written_with_its_scene(simulated: Callable, tmp_path: Path) -> None:
    session = simulated("ur5", poses=16).session
    write_session(tmp_path / "plain", session)
    assert "scene" not in (tmp_path / "plain/session.yaml").read_text()
    write_session(tmp_path / "s", replace(session, scene=(Obstacle("post", (0.1, 0.1, 1), (1, 1, 0.5)),)))
    (post,) = read_session(tmp_path / "s").scene
    np.testing.assert_array_equal(post.size, [0.1, 0.1, 1.0])
    np.testing.assert_array_equal(post.T_base_box[:3, 3], [1.0, 1.0, 0.5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scene: {wall: {size: [0.1, 0, 1], position: [0, 0, 0]}}", "scene.wall.*is not positive"),
        ("scene: {wall: {size: [0.1, 1], position: [0, 0, 0]}}", "key 'scene.wall.size'"),
        ("scene: {wall: {size: [1, 1, 1]}}", "scene.wall.*position"),
        ("boxes: {}", "boxes"),
    ],
)
def test_what_is_no_scene_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "boxes.yaml").write_text(text)
    with pytest.raises(SessionError, match=message):
        read_scene(tmp_path / "boxes.yaml")
