from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import pytest

import urdfcal
from urdfcal.errors import OutputError
from urdfcal.output.exports.tables import joint_offsets
from urdfcal.pipeline import calibrate
from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.output.exports.conftest import Result


def read(written: dict[str, bytes]) -> tuple[dict[str, dict[str, str]], Urdf]:
    table, _, urdf = written.values()
    return {row["joint"]: row for row in csv.DictReader(io.StringIO(table.decode()))}, Urdf.parse(urdf)


def test_readings_with_offsets_and_the_urdf_without_are_the_calibrated_arm(result: Result) -> None:
    drawn, calibrated = result.calibration.chain, result.calibration.calibrated
    table, urdf = read(joint_offsets(result.calibration, result.urdf))
    assert tuple(table) == drawn.actuated
    offsets = np.array([float(row["offset"]) for row in table.values()])
    assert np.abs(offsets).max() > 1e-5
    without = Chain.from_urdf(urdf, drawn.tip_link, drawn.base_link)
    q = drawn.random_values(50, np.random.default_rng(0))[:, [name in drawn.actuated for name in drawn.names]]
    np.testing.assert_allclose(
        tip_poses(without, without.joint_values(q + offsets)),
        tip_poses(calibrated, calibrated.joint_values(q)),
        rtol=0,
        atol=1e-9,
    )
    for joint in drawn.joints:
        if joint.mimic is None:
            assert table[joint.name]["unit"] == ("m" if joint.prismatic else "rad")


def test_ros2_control_adds_them_to_what_it_reads(result: Result) -> None:
    """As its SimpleTransmission does: joint = actuator / reduction + offset."""
    written = joint_offsets(result.calibration, result.urdf)
    table, _ = read(written)
    root = ElementTree.fromstring(written["joint_offsets.ros2_control.xml"])  # noqa: S314  # our own
    found = {}
    for transmission in root.iter("transmission"):
        assert transmission.findtext("plugin") == "transmission_interface/SimpleTransmission"
        joint = transmission.find("joint")
        assert joint is not None
        assert (joint.get("role"), float(joint.findtext("mechanical_reduction", ""))) == ("joint1", 1.0)
        assert len(transmission.findall("actuator[@role='actuator1']")) == 1
        found[joint.get("name")] = float(joint.findtext("offset", ""))
    assert found == {name: float(row["offset"]) for name, row in table.items() if float(row["offset"])}


def test_offsets_are_those_of_the_truth(results: Callable, simulated: Callable) -> None:
    table, _ = read(joint_offsets(results("ur5").calibration, results("ur5").urdf))
    true = simulated("ur5").truth.offsets[:, 0]
    for row, offset in zip(table.values(), true, strict=True):
        if row["sigma"]:
            assert abs(float(row["offset"]) - offset) < 4 * float(row["sigma"])


@pytest.mark.no_cover
def test_an_arm_of_offsets_only_is_written_as_drawn(simulated: Callable, tmp_path: Path) -> None:
    session = replace(simulated("ur5").session, estimate=Estimate(geometry="offsets"))
    fitted = calibrate(session, force=True)  # zero offsets alone do not explain the arm
    _, urdf = read(joint_offsets(fitted, Urdf.parse(fitted.calibrated_urdf())))
    without = Chain.from_urdf(urdf, fitted.chain.tip_link, fitted.chain.base_link)
    np.testing.assert_allclose(without.placements, fitted.chain.placements, atol=1e-12)


def test_whole_placements_have_no_offsets(simulated: Callable) -> None:
    session = replace(simulated("elbow3r").session, estimate=Estimate(geometry="full"))
    fitted = calibrate(session)
    assert isinstance(fitted, urdfcal.Calibration)
    with pytest.raises(OutputError, match="zero offsets are no parameters"):
        joint_offsets(fitted, session.urdf)
