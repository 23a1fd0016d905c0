from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from tests.estimation.problems import Estimated
from tests.worlds import (
    EVENT,
    backlash,
    bumped,
    camera_bumped,
    drifting,
    gain,
    harmonic,
    jumped,
    other_lens,
    sagging,
    seen,
    slipped,
)  # fmt: skip
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.diagnosis.doctor import diagnose
from urdfcal.estimation.diagnosis.residuals import Unexplained
from urdfcal.estimation.noise import find_noise
from urdfcal.pipeline import calibrate
from urdfcal.session.exclusion import labels, leave_out
from urdfcal.session.knowledge import Excluded

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.diagnosis.doctor import Finding
    from urdfcal.session.model import Session

pytestmark = pytest.mark.usefixtures("no_trials")
EFFECTS = {
    "panda_joint2: harmonic 1": (partial(harmonic, share=0.2, order=1), 1.5e-3, r"angle, 1\.[3-7] mrad, once a turn"),
    "panda_joint3: harmonic 2": (partial(harmonic, share=0.33, order=2), 1.5e-3, r"angle, 1\.[3-7] mrad, twice a turn"),
    "panda_joint2: approach": (
        partial(backlash, share=0.2),
        2e-3,
        r"(1\.[89]|2|2\.[12]) mrad apart between approaches",
    ),
    "panda_joint3: gain": (partial(gain, share=0.33), 1e-3, r"\+0\.(09\d|1|11) % more than it reads"),
    "all joints: torque": (sagging, 3e-5, "under the arm's weight, by up to"),
    "cam0: focal length": (other_lens, 3e-3, r"focal length of camera .cam0. is -0\.(2\d*|3\d*|4\d*) % off"),
    "LED 'led': drift": (drifting, 2e-3, "moved steadily from the first pose to the last, by"),
}
EVENTS = {
    "LED 'led'": (slipped, 1e-3, "it slipped"),
    "the robot's base": (bumped, 1e-3, "the base, or what all cameras stand on, was bumped"),
    "camera 'cam1'": (camera_bumped, 3e-4, "it was bumped"),
    "panda_joint2": (partial(jumped, share=0.2), 2e-3, "the encoder jumped"),
}


def unexplained(session: Session) -> Unexplained:
    """Residuals of a rigid arm between perfect joints."""
    of = Estimated.of(session)
    return Unexplained.of(session, of.problem, of.fit, find_noise(of.problem, of.fit))


def findings(session: Session) -> tuple[Finding, ...]:
    return diagnose(session, unexplained(session))


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_in_all_poses_is_named_with_its_size(name: str, simulated: Callable) -> None:
    make, size, words = EFFECTS[name]
    first, *_ = findings(make(simulated("panda", poses=50), size))
    assert first.name == name
    assert re.search(words, first.sentence), first.sentence
    assert first.pose is None
    assert 0.1 < first.share <= 1.0
    assert first.p < 0.005


@pytest.mark.parametrize("what", EVENTS)
def test_an_event_is_named_with_its_pose(what: str, simulated: Callable) -> None:
    make, size, words = EVENTS[what]
    data = simulated("panda", poses=50)
    session = make(data, size)
    first, *_ = findings(session)
    assert first.name == f"{what}: change"
    assert abs(first.pose - EVENT) <= 2
    assert first.sentence.startswith(f"from pose {session.poses[first.pose]} on {what} is ")
    assert words in first.sentence
    if what == "the robot's base":
        assert f"; say that it moved (moved: {{base: [{session.poses[first.pose]}]}}), or leave out" in first.sentence


@pytest.mark.no_cover
@pytest.mark.parametrize(("first", "which"), [(0, "these poses"), (20, "the poses before")])
def test_an_event_says_how_to_do_without_the_shorter_side(first: int, which: str, simulated: Callable) -> None:
    session = slipped(simulated("panda", poses=50), 1e-3).at(np.arange(first, 50))
    finding, *_ = findings(session)
    said = re.search(rf", or leave out {which} \(exclude: {{poses: \[(.*)\]}}\)$", finding.sentence)
    assert said, finding.sentence
    poses = labels(said[1], session.poses, "")
    assert poses == (session.poses[finding.pose :] if first == 0 else session.poses[: finding.pose])
    assert not [left for left in findings(leave_out(session, Excluded(poses))) if left.name == finding.name]


def test_what_a_joint_model_explains_is_no_longer_named(simulated: Callable) -> None:
    session = sagging(simulated("panda", poses=50), 3e-5)
    assert {finding.name for finding in findings(session)} & {"all joints: torque"}
    calibration = calibrate(session, force=True)
    assert "compliance" in {term.model for term in calibration.comparison.chosen.spec.terms}
    assert calibration.evidence.findings == ()


def test_two_causes_are_both_named(simulated: Callable) -> None:
    data = simulated("panda", poses=50)
    session = slipped(type(data)(session=harmonic(data, 3e-3, share=0.2, order=1), truth=data.truth), 2e-3)
    names = [finding.name for finding in findings(session)]
    assert set(names[:2]) == {"panda_joint2: harmonic 1", "LED 'led': change"}


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", ["ur5", "stanford", "ur5_handeye", "tiago_dual"])
def test_nothing_is_found_in_a_clean_session(rig: str, simulated: Callable) -> None:
    assert findings(simulated(rig, poses=40).session) == ()


def test_outliers_are_no_event(simulated: Callable) -> None:
    assert findings(simulated("ur5", poses=50, outliers=0.05).session) == ()


def test_a_camera_bumped_so_far_that_all_later_detections_are_outliers(simulated: Callable) -> None:
    first, *_ = findings(camera_bumped(simulated("ur5", poses=50), 3e-3))
    assert first.name == "camera 'cam1': change"
    assert abs(first.pose - EVENT) <= 2


def test_what_an_effect_explains_is_what_least_squares_with_it_would(simulated: Callable) -> None:
    left = unexplained(simulated("elbow3r", poses=20).session)
    rng = np.random.default_rng(0)
    effect = np.vstack([rng.normal(size=(len(left.pose), 2)), np.zeros((len(left.r) - len(left.pose), 2))])
    gain, size, covariance = left.explained(effect)
    joined = np.hstack([left.Q, effect])
    solution, (rest,), *_ = np.linalg.lstsq(joined, -left.r, rcond=None)
    assert gain == pytest.approx(left.total - rest, rel=1e-8)
    np.testing.assert_allclose(size, solution[-2:], rtol=1e-8)
    np.testing.assert_allclose(covariance, np.linalg.inv(joined.T @ joined)[-2:, -2:], rtol=1e-8)
    less = left.less(effect)
    assert less.total == pytest.approx(rest, rel=1e-8)
    assert less.explained(effect)[0] == pytest.approx(0.0, abs=1e-8 * left.total)


def test_the_estimate_itself_explains_nothing_more(simulated: Callable) -> None:
    left = unexplained(simulated("elbow3r", poses=20).session)
    assert left.explained(left.Q[:, :3])[0] == pytest.approx(0.0, abs=1e-9 * left.total)
    np.testing.assert_allclose(left.Q.T @ left.r, 0.0, atol=1e-8)


def test_what_cannot_be_told_apart_is_said_and_mended_as_a_bump(simulated: Callable) -> None:
    session = jumped(simulated("panda", poses=50), 2e-3, share=0.0)
    first, *_ = findings(session)
    assert {first.name, *first.alike} >= {"panda_joint1: change", "the robot's base: change"}
    assert f"; say that it moved (moved: {{base: [{session.poses[first.pose]}]}}), or leave out" in first.sentence


def test_a_target_that_slipped_cannot_be_said_to_have_moved(simulated: Callable) -> None:
    data = simulated("ur5_charuco", poses=50)
    shift, key = pin.exp6(np.array([1e-3, 1e-3, 1e-3, 2e-3, -3e-3, 2e-3])).homogeneous, target_key("board")
    session = seen(data, late=lambda state: state.replace({key: state[key] @ shift}))
    first, *_ = findings(session)
    assert "board" in first.name
    assert "; leave out these poses (exclude: " in first.sentence


def test_a_joint_that_jumped_is_no_other_thing(simulated: Callable) -> None:
    first, *_ = findings(jumped(simulated("panda", poses=50), 2e-3, share=0.5))
    assert "the encoder jumped; leave out these poses (exclude: " in first.sentence
