from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.cameras import camera_poses
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.start import first_state
from urdfcal.robot.dh import DHTable
from urdfcal.session.knowledge import Led

if TYPE_CHECKING:
    from collections.abc import Callable


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
    difference = pin.SE3(found[BASE]).inverse() * pin.SE3(data.truth.T_world_base)
    assert np.linalg.norm(difference.translation) < 0.15
    assert np.linalg.norm(pin.log3(difference.rotation)) < 0.15


def test_of_many_poses_some_serve_and_rare_detections_count(simulated: Callable) -> None:
    # A second camera of unknown pose sees the LED in 8 of 500 poses: they must all reach the start.
    data = simulated("ur5", poses=500)
    seen = data.session.find(Detections)
    rare = (seen.camera == 0) | np.isin(seen.pose, np.arange(1, 500, 63))
    rig = replace(data.session.rig, T_cam_world=(data.session.rig.T_cam_world[0], None))
    session = replace(data.session, measurements=(seen.rows(rare),), rig=rig)
    table = DHTable.from_chain(session.chain)
    found = first_state(session, table, np.zeros_like(table.nominal))
    apart = pin.SE3(camera_poses(session.attachments, found)[1]).inverse() * pin.SE3(data.session.rig.T_cam_world[1])
    assert np.linalg.norm(apart.translation) < 0.15
    assert np.linalg.norm(pin.log3(apart.rotation)) < 0.15
