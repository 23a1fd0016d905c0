from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

import urdfcal
from urdfcal.output.placing import link_frames
from urdfcal.output.scene import build_scene

if TYPE_CHECKING:
    from collections.abc import Callable


def test_the_calibrated_arm_is_shown_with_its_joint_models(simulated: Callable) -> None:
    session = replace(simulated("ur5", poses=20).session, joint_models={"compliance": True})
    calibration = urdfcal.calibrate(session, force=True)
    shown = link_frames(build_scene(calibration).frames, calibration.chain.tips[0])
    full = calibration.forward(calibration.session.readings)
    np.testing.assert_allclose(shown, full, atol=1e-9)
    sag = calibration.joint_values(calibration.session.readings) - calibration.session.q
    assert np.abs(sag).max() > 1e-6
