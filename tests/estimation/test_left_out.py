from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from urdfcal.arrays import rms
from urdfcal.estimation.left_out import find_left_out
from urdfcal.pipeline import calibrate
from urdfcal.session.exclusion import leave_out
from urdfcal.session.knowledge import Estimate, Excluded

if TYPE_CHECKING:
    from collections.abc import Callable


def test_poses_left_out_show_the_error_of_the_estimate_there(simulated: Callable) -> None:
    whole = replace(simulated("ur5", poses=16).session, estimate=Estimate("dh", "fixed", "fixed"))
    kept = leave_out(whole, Excluded(poses=whole.poses[12:]))
    calibration = calibrate(kept, force=True)
    found = calibration.evidence.left_out
    assert found is not None
    assert found.poses == 4
    held_out = rms(calibration.comparison.chosen.residuals("distance"))
    assert 0.3 * held_out < found.rms < 2.0 * held_out
    assert found.rms < found.largest
    worse = calibration.nominal_fit.state
    assert find_left_out(kept, calibration.problem, worse).rms > 2.0 * found.rms
    for poses in (whole.poses[14:], ()):
        fewer = leave_out(whole, Excluded(poses=poses))
        assert find_left_out(fewer, calibration.problem, worse) is None
    triangulated = calibrate(kept, force=True, method="points")
    assert triangulated.evidence.left_out is None


def test_where_the_base_was_bumped_nothing_is_predicted(simulated: Callable) -> None:
    whole = replace(simulated("ur5", poses=16).session, estimate=Estimate("dh", "fixed", "fixed"))
    bumped = replace(whole, moved={"base": (whole.poses[6],)})
    calibration = calibrate(leave_out(bumped, Excluded(poses=whole.poses[12:])), force=True)
    assert calibration.evidence.left_out is None


def test_where_a_camera_went_too_nothing_is_predicted(simulated: Callable) -> None:
    whole = replace(simulated("ur5", poses=16).session, estimate=Estimate("dh", "fixed", "fixed"))
    one = leave_out(whole, Excluded(poses=whole.poses[12:], cameras=(whole.rig.names[1],)))
    calibration = calibrate(whole, force=True)
    assert find_left_out(one, calibration.problem, calibration.fit.state) is None
