"""Several sessions in one picture: every world is placed by its own base."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import EVENT, bumped
from urdfcal.output.images import find_photographs
from urdfcal.output.scene import build_scene
from urdfcal.pipeline import calibrate
from urdfcal.session.combine import combine
from urdfcal.session.moves import resolve_moves

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.mark.no_cover
@pytest.mark.parametrize("own_cameras", [False, True])
def test_what_was_measured_is_where_the_arm_was_in_each_session(own_cameras: bool, simulated: Callable) -> None:
    data = simulated("ur5", poses=60)
    late, poses = bumped(data, 0.02), np.arange(60)
    a, b = late.at(poses[:EVENT]), late.at(poses[EVENT:])
    if own_cameras:
        lens = replace(b.rig.cameras[0], distortion=b.rig.cameras[0].distortion + 1e-9)
        b = replace(b, rig=replace(b.rig, cameras=(lens, *b.rig.cameras[1:])))
    scene = build_scene(calibrate(combine({"a": a, "b": b})))
    apart = np.linalg.norm(scene.leds.measured - scene.leds.predicted, axis=1)
    assert np.median(apart) < 1e-3
    assert apart.max() < 5e-3
    jumps = np.linalg.norm(np.diff(scene.views[..., :3, 3], axis=1), axis=-1) > 1e-6
    assert len(jumps) == (4 if own_cameras else 2)
    for camera in jumps:  # a camera of one session stays in its world
        assert np.flatnonzero(camera).tolist() == ([] if own_cameras else [EVENT - 1])


def test_images_are_those_of_what_moved_under_its_first_name(simulated: Callable, tmp_path: Path) -> None:
    session = replace(simulated("ur5", poses=8).session, folder=tmp_path)
    left, right = session.rig.names
    for camera in (left, right):
        (tmp_path / "images" / camera).mkdir(parents=True)
        for pose in session.poses:
            (tmp_path / "images" / camera / f"{pose}.png").touch()
    moved = replace(session, moved={right: session.poses[5:6], "led": session.poses[3:4]})
    found = find_photographs(resolve_moves(moved))
    whole = find_photographs(session)
    assert [sorted(of) for of in found] == [list(range(8)), list(range(5)), [5, 6, 7]]
    assert found[0] == whole[0]
    assert found[1] | found[2] == whole[1]


def test_pictures_of_targets_are_shown_too(simulated: Callable, tmp_path: Path) -> None:
    session = replace(simulated("ur5_charuco", poses=5).session, folder=tmp_path)
    (camera,) = session.rig.names
    (tmp_path / "images" / camera).mkdir(parents=True)
    for pose in session.poses[1:4]:
        (tmp_path / "images" / camera / f"{pose}.png").touch()
    (found,) = find_photographs(session)
    assert {k: path.name for k, path in found.items()} == {k: f"{session.poses[k]}.png" for k in (1, 2, 3)}
