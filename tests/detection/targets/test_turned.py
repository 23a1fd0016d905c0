"""Which way round a target is that looks the same turned around."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.detection.targets.turned import View, is_guessed, readings
from urdfcal.errors import SessionError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.session.pattern import ChessboardPattern, CirclesPattern, Pattern
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.session.model import Positions
    from urdfcal.simulation.truth import Simulated

POSES = 12


def seen(
    rig: str, pattern: Pattern, *, known: bool, poses: int = POSES
) -> tuple[Simulated, Positions, list[View], np.ndarray]:
    """What a simulated arm's cameras find of a target, each picture read some way round."""
    description = read_rig(find_rig(rig))
    (target,) = description.targets
    simulated = simulate(replace(description, targets=(replace(target, pattern=pattern),)), poses=poses, seed=2)
    positions = simulated.session.unmeasured()
    if not known:
        (target,) = positions.targets
        positions = replace(positions, targets=(replace(target, T_link_target=None, sigma=None),))
    rng, views, ways = np.random.default_rng(0), [], []
    uv = simulated.truth.pixels(simulated.truth.q)
    for pose, camera in np.ndindex(uv.shape[:2]):
        if np.isfinite(uv[pose, camera]).all():
            ways.append(int(rng.integers(len(pattern.symmetries))))
            noisy = uv[pose, camera] + rng.normal(0.0, 0.2, uv[pose, camera].shape)
            views.append(View(camera, pose, noisy[pattern.symmetries[ways[-1]]]))
    return simulated, positions, views, np.array(ways)


@pytest.mark.parametrize("pattern", [ChessboardPattern((7, 5), 0.03), ChessboardPattern((6, 6), 0.03)], ids=str)
@pytest.mark.parametrize("rig", ["ur5_charuco", "panda_handeye"])
@pytest.mark.parametrize("known", [True, False])
def test_all_pictures_are_read_one_way_and_as_it_is_fastened(rig: str, pattern: Pattern, known: bool) -> None:
    simulated, positions, views, ways = seen(rig, pattern, known=known)
    assert len(set(ways.tolist())) == len(pattern.symmetries)
    orders = readings(positions, 0, views)
    true, found = simulated.truth.pixels(simulated.truth.q), []
    for view, order in zip(views, orders, strict=True):
        assert order is not None
        uv = view.uv[order]
        off = [np.linalg.norm(uv - true[view.pose, view.camera][of], axis=1).max() for of in pattern.symmetries]
        found.append(int(np.argmin(off)))
        assert min(off) < 2.0
    assert len(set(found)) == 1
    assert not known or found[0] == 0


def test_two_cameras_read_it_the_same_way() -> None:
    pattern = CirclesPattern((6, 5), 0.03)
    description = read_rig(find_rig("ur5_charuco"))
    other = read_rig(find_rig("ur5")).rig
    (target,) = description.targets
    two = replace(description, rig=other, stand=read_rig(find_rig("ur5")).stand)
    simulated = simulate(replace(two, targets=(replace(target, pattern=pattern),)), poses=POSES, seed=2)
    positions = simulated.session.unmeasured()
    positions = replace(positions, targets=(replace(positions.targets[0], T_link_target=None, sigma=None),))
    uv, views = simulated.truth.pixels(simulated.truth.q), []
    for pose in range(POSES):
        for camera in range(2):
            views.append(View(camera, pose, uv[pose, camera][:: 1 if (pose + camera) % 3 else -1]))
    orders = readings(positions, 0, views)
    ways = {
        np.linalg.norm(view.uv[order] - uv[view.pose, view.camera], axis=1).max() < 1.0
        for view, order in zip(views, orders, strict=True)
        if order is not None
    }
    assert len(ways) == 1


def test_an_arm_that_did_not_move_so_tells_nothing() -> None:
    _, positions, views, _ = seen("ur5_charuco", ChessboardPattern((7, 5), 0.03), known=False)
    other = np.random.default_rng(1).permutation(POSES)
    orders = readings(replace(positions, q=positions.q[other]), 0, views)
    assert sum(order is None for order in orders) > len(orders) / 2


def test_where_it_is_fastened_must_show_if_it_is_given() -> None:
    _, positions, views, _ = seen("ur5_charuco", ChessboardPattern((7, 5), 0.03), known=True)
    still = replace(positions, q=np.repeat(positions.q[:1], POSES, axis=0))
    with pytest.raises(
        SessionError, match="camera 'cam0' does not tell which way it is: the arm turned about one axis"
    ):
        readings(still, 0, [replace_pose(views[0], k) for k in range(POSES)])


def way(simulated: Simulated, view: View, order: np.ndarray | None) -> int | None:
    """Which of its ways round a target was read; None where that was left open."""
    true = simulated.truth.pixels(simulated.truth.q)[view.pose, view.camera]
    orders = simulated.session.targets[0].pattern.symmetries
    off = [np.linalg.norm(view.uv[order] - true[of], axis=1).max() for of in orders if order is not None]
    return int(np.argmin(off)) if off else None


@pytest.mark.parametrize(
    ("rig", "base", "pattern", "known"),
    [
        ("ur5_charuco", True, ChessboardPattern((7, 5), 0.03), True),
        ("ur5_charuco", False, ChessboardPattern((6, 6), 0.03), False),
        ("panda_handeye", False, ChessboardPattern((7, 5), 0.03), False),
    ],
)
def test_it_is_fastened_the_same_after_a_move(rig: str, base: bool, pattern: Pattern, known: bool) -> None:
    simulated, positions, views, _ = seen(rig, pattern, known=known, poses=20)
    # Seen so by a camera that stands on its head from there on, or once the base has turned half around.
    lens, at, halves = positions.rig.cameras[0], 8, [-1.0, -1.0, 1.0]
    shown = [
        view if view.pose < at else replace(view, uv=lens.project(lens.unproject(view.uv) * halves)) for view in views
    ]
    orders = readings(replace(positions, moved={"base" if base else lens.name: positions.poses[at : at + 1]}), 0, shown)
    read = [way(simulated, view, order) for view, order in zip(views, orders, strict=True)]
    assert len(set(read)) == 1
    assert None not in read
    assert not known or read[0] == 0
    unsaid = readings(positions, 0, shown)
    assert len({way(simulated, view, order) for view, order in zip(views, unsaid, strict=True)}) > 1


def test_few_pictures_after_a_move_are_left_out_rather_than_read_wrong() -> None:
    simulated, positions, views, _ = seen("ur5_charuco", ChessboardPattern((7, 5), 0.03), known=False)
    orders = readings(replace(positions, moved={"base": positions.poses[10:11]}), 0, views)
    read = [way(simulated, view, order) for view, order in zip(views, orders, strict=True)]
    assert read[10:] == [None, None]
    assert len(set(read[:10])) == 1


def test_a_target_in_the_world_is_nearest_to_how_it_was_before_the_base_moved() -> None:
    simulated, positions, views, _ = seen("panda_handeye", ChessboardPattern((7, 5), 0.03), known=False, poses=20)
    assert is_guessed(replace(positions, moved={"base": positions.poses[8:9]}), 0)
    assert not is_guessed(positions, 0)
    orders = readings(replace(positions, moved={"base": positions.poses[8:9]}), 0, views)
    assert len({way(simulated, view, order) for view, order in zip(views, orders, strict=True)}) == 1


def replace_pose(view: View, pose: int) -> View:
    return View(view.camera, pose, view.uv)
