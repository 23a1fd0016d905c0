from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import CalibrationError
from urdfcal.estimation.start import first_state, kabsch, place_base
from urdfcal.robot.dh import DHTable
from urdfcal.session.model import Led

if TYPE_CHECKING:
    from collections.abc import Callable


def random_pose(rng: np.random.Generator) -> np.ndarray:
    R = pin.exp3(rng.normal(0.0, 2.0, 3))
    return pin.SE3(R, rng.normal(0.0, 2.0, 3)).homogeneous


def test_kabsch_recovers_a_motion_and_never_a_reflection() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        T, points = random_pose(rng), rng.normal(size=(12, 3))
        np.testing.assert_allclose(kabsch(points, points @ T[:3, :3].T + T[:3, 3]), T, atol=1e-12)
        assert np.linalg.det(kabsch(points, -points)[:3, :3]) > 0.999


@pytest.mark.parametrize("leds", [1, 3])
def test_base_and_unknown_leds_are_found_from_anywhere(leds: int) -> None:
    rng = np.random.default_rng(leds)
    for _ in range(20):
        T_base_tip = np.array([random_pose(rng) for _ in range(20)])
        T_world_base, places = random_pose(rng), rng.normal(0.0, 0.1, (leds, 3))
        pose, led = np.repeat(np.arange(20), leds), np.tile(np.arange(leds), 20)
        in_base = (T_base_tip[pose] @ np.c_[places[led], np.ones(len(led))][..., None])[:, :3, 0]
        points = in_base @ T_world_base[:3, :3].T + T_world_base[:3, 3]
        T, found = place_base(
            T_base_tip[pose], led, points, np.zeros((leds, 3)), np.ones(leds, bool), np.zeros(leds, bool)
        )
        np.testing.assert_allclose(T, T_world_base, atol=1e-9)
        np.testing.assert_allclose(found, places, atol=1e-9)


def test_too_few_points_say_so() -> None:
    T, guess, flag = np.eye(4)[None].repeat(3, 0), np.zeros((1, 3)), np.ones(1, bool)
    with pytest.raises(CalibrationError, match="only 3 points"):
        place_base(T, np.zeros(3, int), np.eye(3), guess, flag, ~flag)


@pytest.mark.parametrize("rig", ["elbow3r", "ur5", "panda", "so101", "stanford"])
@pytest.mark.parametrize("known", ["extrinsics", "nothing"])
def test_the_start_is_near_the_truth_on_every_rig(rig: str, known: str, simulated: Callable) -> None:
    data = simulated(rig)
    session = data.session
    if known == "nothing":
        T_cam_world = (session.rig.T_cam_world[0], None)
        session = replace(session, rig=replace(session.rig, T_cam_world=T_cam_world), leds=(Led("led"),))
    table = DHTable.from_chain(session.chain)
    found = first_state(session, table, np.zeros_like(table.nominal))
    difference = pin.SE3(found.T_world_base).inverse() * pin.SE3(data.truth.T_world_base)
    assert np.linalg.norm(difference.translation) < 0.15
    assert np.linalg.norm(pin.log3(difference.rotation)) < 0.15


def test_of_many_poses_some_serve_and_rare_sightings_count(simulated: Callable) -> None:
    # A second camera of unknown pose sees the LED in 8 of 500 poses: they must all reach the start.
    data = simulated("ur5", poses=500)
    seen = data.session.detections
    rare = (seen.camera == 0) | np.isin(seen.pose, np.arange(1, 500, 63))
    columns = {name: column[rare] for name, column in vars(seen).items()}
    rig = replace(data.session.rig, T_cam_world=(data.session.rig.T_cam_world[0], None))
    session = replace(data.session, detections=type(seen)(**columns), rig=rig)
    table = DHTable.from_chain(session.chain)
    found = first_state(session, table, np.zeros_like(table.nominal))
    apart = pin.SE3(found.T_cam_world[1]).inverse() * pin.SE3(data.session.rig.T_cam_world[1])
    assert np.linalg.norm(apart.translation) < 0.15
    assert np.linalg.norm(pin.log3(apart.rotation)) < 0.15
