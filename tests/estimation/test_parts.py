"""Sessions of several parts: each has its world, the arm is the same."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from tests.estimation.derivatives import assert_derivatives, names_of
from tests.estimation.problems import Estimated
from tests.worlds import ALONE, EVENT, bumped, camera_bumped, slipped
from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.base_pose import BASE, base_keys
from urdfcal.estimation.blocks.cameras import camera_values
from urdfcal.estimation.evaluation import compare, explain
from urdfcal.estimation.measurements import Points
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.start import first_state
from urdfcal.pipeline import calibrate
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.combine import combine
from urdfcal.session.moves import resolve_moves

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated


def tracked(session: Session) -> Session:
    """The session with points instead of pixels."""
    found = triangulate(session)
    points = Points(found.pose, found.led, found.xyz, np.full(len(found), 3e-4))
    return replace(
        session,
        measurements=(points,),
        rig=replace(session.rig, cameras=(), T_cam_world=(), sigmas=(), group=(), lens=()),
    )


def halves(session: Session, first: int = EVENT) -> tuple[Session, Session]:
    poses = np.arange(len(session.poses))
    return session.at(poses[:first]), session.at(poses[first:])


def tip_error(found: FittedCalibration | Estimated, data: Simulated) -> float:
    """Rms error of the calibrated tip over the workspace. [mm]"""
    chain = data.session.chain
    q = chain.random_values(300, np.random.default_rng(1))
    arms = (chain.with_placements(of) for of in (data.truth.placements, found.placements))
    apart = compare(*arms, q).position
    return 1e3 * float(np.sqrt(np.mean(apart**2)))


def derived(session: Session) -> None:
    problem = Problem.of(session, rows_of(session.chain))
    start = first_state(session, problem.arm, no_offsets(problem.arm))
    count = len(camera_values(session.attachments, start))
    spec = ModelSpec("dh", ("free",) * count, ("free",) * count)
    parameters = choose_parameters(session, problem, start, spec)
    state = parameters.retract(start, np.random.default_rng(0).normal(0.0, 1e-3, parameters.count))
    worlds = {name.rpartition(".")[0] for name in names_of(parameters) if BASE.name in name}
    assert worlds == {key.name for key in base_keys(session.parts)}
    for observed in problem.observations:
        assert_derivatives(problem, observed, state, parameters)


@pytest.mark.no_cover
def test_derivatives_by_every_world_agree_with_finite_differences(simulated: Callable) -> None:
    a, b = (simulated("panda", poses=14, seed=seed).session for seed in (0, 1))
    derived(combine({"a": a, "b": b}))
    lens = a.rig.cameras[0]
    own = replace(b.rig, cameras=(replace(lens, intrinsics=lens.intrinsics + 1.0), *b.rig.cameras[1:]))
    derived(combine({"a": a, "b": replace(b, rig=own)}))
    derived(combine({"a": a, "b": tracked(b)}))
    derived(combine({"a": tracked(a), "b": tracked(b)}))
    derived(resolve_moves(replace(a, moved={"led": a.poses[7:8], "base": a.poses[8:9], a.rig.names[1]: a.poses[5:6]})))


def test_without_a_standing_camera_the_base_link_is_the_world_of_a_session(simulated: Callable) -> None:
    stood, hand = simulated("ur5", poses=20).session, simulated("ur5_handeye", poses=20).session
    links = list(dict.fromkeys([stood.chain.tip_link, *(tip.link for tip in hand.chain.tips)]))
    chain = read_mechanism(stood.urdf, links, stood.chain.base_link)
    assert chain.names == hand.chain.names
    both = combine({"stood": replace(stood, chain=chain), "hand": replace(hand, chain=chain, noise=stood.noise)})
    problem = Problem.of(both, rows_of(both.chain))
    start = first_state(both, problem.arm, no_offsets(problem.arm))
    parameters = choose_parameters(both, problem, start, ModelSpec("dh", ("fixed",) * 3, ("fixed",) * 2 + ("free",)))
    first, second = base_keys(both.parts)
    assert parameters.has_active(first)
    assert not parameters.has_active(second)
    assert np.array_equal(start[second], np.eye(4))


@pytest.mark.no_cover
def test_after_a_bump_nothing_measured_is_thrown_away(simulated: Callable) -> None:
    data = simulated("ur5", poses=60)
    late = bumped(data, 0.02)
    a, b = halves(late)
    whole, *alone = (tip_error(Estimated.of(session), data) for session in (data.session, a, b))
    together = calibrate(replace(combine({"a": a, "b": b}), **ALONE))
    assert tip_error(together, data) < min(1.4 * whole, *alone)
    assert together.assessment.level == "good"
    T_a, T_b = (pin.SE3(T) for T in together.estimate.T_world_bases)
    true = pin.SE3(data.truth.T_world_base)
    assert np.linalg.norm(pin.log6(true.inverse() * T_a).vector) < 2e-3
    assert 0.01 < np.linalg.norm(pin.log6(T_a.inverse() * T_b).linear) < 0.03
    said = Estimated.of(resolve_moves(replace(late, moved={"base": late.poses[EVENT : EVENT + 1]})))
    assert tip_error(said, data) < min(1.4 * whole, *alone)
    T = [said.fit.state[key] for key in base_keys(said.session.parts)]
    np.testing.assert_allclose(T, together.estimate.T_world_bases, atol=2e-3)


@pytest.mark.no_cover
def test_what_moved_is_something_else_from_then_on(simulated: Callable) -> None:
    data = simulated("ur5", poses=60)
    whole = tip_error(Estimated.of(data.session), data)
    camera = data.session.rig.names[1]
    for late, what in ((slipped(data, 0.02), "led"), (camera_bumped(data, 0.02), camera)):
        said = calibrate(replace(late, moved={what: late.poses[EVENT : EVENT + 1]}, **ALONE))
        assert said.assessment.level == "good", what
        assert tip_error(said, data) < 1.4 * whole, what
    first, second = said.estimate.T_cam_frame[1:]
    apart = pin.log6(pin.SE3(second @ inverse(first)))
    assert np.linalg.norm(apart.linear) == pytest.approx(0.02, abs=2e-3)


def test_a_session_is_explained_with_what_moved(simulated: Callable) -> None:
    data = simulated("ur5", poses=60)
    true = data.session.chain.with_placements(data.truth.placements)
    late = bumped(data, 0.02)
    (residual,) = explain(true, replace(late, moved={"base": late.poses[EVENT : EVENT + 1]})).residuals
    assert np.sqrt(np.mean(residual**2)) < 0.2


@pytest.mark.no_cover
def test_events_are_found_in_each_session_and_said_of_it(simulated: Callable) -> None:
    data = simulated("ur5", poses=60)
    a, b = halves(slipped(data, 5e-3), 20)
    assert EVENT > 20
    found = calibrate(replace(combine({"a": a, "b": b}), **ALONE), force=True)
    first, *_ = found.evidence.findings
    assert first.name == "LED 'b/led': change"
    label = data.session.poses[first.pose]
    assert first.sentence.startswith(f"from pose b/{label} on LED 'b/led' is ")
    assert f"say that it moved (moved: {{led: [{label}]}}), or leave out the poses before (exclude: " in first.sentence
    assert first.sentence.endswith(" in 'b'")
    a, b = halves(bumped(data, 0.02))
    assert not calibrate(replace(combine({"a": a, "b": b}), **ALONE)).evidence.findings
