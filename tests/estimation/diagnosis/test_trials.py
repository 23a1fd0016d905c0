from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import RIGID, exchanged, images, inverted, other_robot, other_sign, shifted
from urdfcal.errors import CalibrationError
from urdfcal.estimation.diagnosis.trials import suspect
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate
from urdfcal.simulation.motion import MotionSettings, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable

MISTAKES = {
    "joint_2's sign": partial(other_sign, share=0.4),
    "the columns of joint_2 and joint_3 are exchanged": partial(exchanged, first=1),
    "joint readings are shifted by 1 row against what was measured": partial(shifted, by=1),
    "joint readings are shifted by 2 rows against what was measured": partial(shifted, by=-2),
    "T_cn_cnm1 of cam1 is inverted": inverted,
    "the images of the cameras are mirrored": partial(
        images, change=lambda uv, size: np.stack([size[:, 0] - 1.0 - uv[:, 0], uv[:, 1]], axis=1)
    ),
    "the images of the cameras are upside down": partial(images, change=lambda uv, size: size - 1.0 - uv),
    "the images of the cameras have half the resolution that the camera file says": partial(
        images, change=lambda uv, _: 0.5 * (uv - 0.5)
    ),
    "the images of the cameras have twice the resolution that the camera file says": partial(
        images, change=lambda uv, _: 2.0 * uv + 0.5
    ),
    "the robot is ur5_gripper, not ur3": other_robot,
}


@pytest.mark.no_cover
@pytest.mark.parametrize("what", MISTAKES)
def test_the_mistake_is_named_with_what_mending_it_brings(what: str, simulated: Callable) -> None:
    data = simulated("ur5" if what.startswith("the robot is ur5") else "elbow3r", poses=12)
    suspicion = suspect(MISTAKES[what](data, 0.0))
    assert suspicion is not None
    assert suspicion.what == what
    assert suspicion.unit == "px"
    assert suspicion.after < 3.0
    assert suspicion.before > 10.0
    assert f"{what}: with that mended the nominal arm is {suspicion.after:.3g} px off instead of" in str(suspicion)


@pytest.mark.no_cover
def test_nothing_is_suspected_of_a_good_session(simulated: Callable) -> None:
    assert suspect(simulated("elbow3r", poses=12).session) is None


@pytest.mark.no_cover
def test_two_mistakes_are_not_blamed_on_one(simulated: Callable) -> None:
    data = simulated("elbow3r", poses=12)
    both = other_sign(data, 0.0, share=0.4)
    both = shifted(type(data)(session=both, truth=data.truth), 0.0, by=1)
    assert suspect(both) is None


@pytest.mark.no_cover
def test_a_calibration_that_fails_says_what_would_mend_it(simulated: Callable) -> None:
    data = simulated("elbow3r", poses=12)
    wrong = replace(other_sign(data, 0.0, share=0.4), estimate=Estimate("dh", "fixed", "fixed"), joint_models=RIGID)
    steps: list[float] = []
    with pytest.raises(CalibrationError, match="joint_2's sign: with that mended"):
        calibrate(wrong, progress=lambda _, cost: steps.append(cost))
    assert len(steps) > 100  # the trials show that they go on


def test_a_wrong_sign_is_found_in_the_log_of_a_moving_arm(simulated: Callable) -> None:
    moving = set_in_motion(simulated("elbow3r", poses=8), MotionSettings(frame_rate=2.0)).session
    log = moving.motion.log
    elbow = np.array([1.0, -1.0, 1.0])
    wrong = replace(
        moving, q=moving.q * elbow, motion=replace(moving.motion, log=replace(log, values=log.values * elbow))
    )
    assert str(suspect(wrong)).startswith("joint_2's sign: with that mended")
    assert suspect(moving) is None
