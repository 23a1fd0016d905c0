"""Several sessions in one picture: every world is placed by its own base."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import EVENT, bumped
from urdfcal.output.scene import build_scene
from urdfcal.pipeline import calibrate
from urdfcal.session.combine import combine

if TYPE_CHECKING:
    from collections.abc import Callable


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
