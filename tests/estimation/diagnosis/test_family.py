"""A correction that the readings have already must not be applied twice: it is noticed where calibration undoes it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.chain import Chain
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated


@pytest.fixture(scope="module")
def true_arm() -> Simulated:
    return simulate(read_rig(find_rig("ur5")), seed=3, poses=40)


@pytest.fixture(scope="module")
def corrected_by_its_controller() -> Simulated:
    """What a controller's readings make of an arm whose errors it takes out: an arm as drawn."""
    return simulate(read_rig(find_rig("ur5")), seed=4, poses=40, error_scale=0.0)


def undone(session: Session, folder: Path, urdf: bytes, beside: bytes) -> list[str]:
    """What is said of it when the session is calibrated with one URDF, and another one is beside that."""
    (folder / "arm_factory.urdf").write_bytes(urdf)
    (folder / "arm.urdf").write_bytes(beside)
    robot, chain = Urdf.read(folder / "arm_factory.urdf"), session.chain
    session = replace(session, urdf=robot, chain=Chain.from_urdf(robot, chain.tip_link, chain.base_link))
    return [reason for reason in calibrate(session, force=True).assessment.reasons if "undone" in reason]


def test_a_correction_that_calibration_takes_back_may_be_in_the_readings(
    corrected_by_its_controller: Simulated, true_arm: Simulated, tmp_path: Path
) -> None:
    drawing = true_arm.session.urdf.data
    (reason,) = undone(corrected_by_its_controller.session, tmp_path, true_arm.truth.urdf, drawing)
    assert reason.startswith("the arm comes out as arm has it (0.")
    assert "use arm.urdf and correct once" in reason


def test_a_correction_that_is_right_stays(true_arm: Simulated, tmp_path: Path) -> None:
    assert undone(true_arm.session, tmp_path, true_arm.truth.urdf, true_arm.session.urdf.data) == []


def test_that_an_arm_comes_out_as_it_was_corrected_before_is_no_harm(true_arm: Simulated, tmp_path: Path) -> None:
    assert undone(true_arm.session, tmp_path, true_arm.session.urdf.data, true_arm.truth.urdf) == []
