from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from urdfcal.estimation.time_offset import start_state

from urdfcal.estimation.linearize import predict, view
from urdfcal.estimation.multistart import _same_arm
from urdfcal.estimation.observations import observe
from urdfcal.estimation.start import kabsch
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.session.model import Estimate, Noise
from urdfcal.simulation.motion import Motion, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable


def test_the_seeds_problem_a_3r_arm_from_wild_starts(simulated: Callable, true_state: Callable) -> None:
    # a, d and alpha of a three-axis arm unknown, no priors, no noise: Rossi and Savino's example.
    data = simulated("elbow3r", poses=30)
    session = replace(
        data.session,
        q=data.truth.q,
        noise=Noise(0.1, 1e-4, 0.0),
        leds=tuple(replace(led, position=None, sigma=None) for led in data.session.leds),
        estimate=Estimate("dh", "fixed", "fixed"),
    )
    table, (block,) = DHTable.from_chain(session.chain), observe(session)
    uv = block.by_row(predict(table, block, true_state(data)))
    session = replace(session, detections=replace(session.detections, uv=uv))
    calibration = calibrate(session, priors=False, starts=24, seed=3)

    reasons = [solution.reason for solution in calibration.solutions]
    assert len(reasons) == 25
    assert all(reasons)
    assert [solution.kept for solution in calibration.solutions].count(True) == 1
    assert calibration.solutions[0].kept
    assert any("other signs" in reason for reason in reasons)
    assert any("chi-square" in reason or "did not settle" in reason or "no start" in reason for reason in reasons)

    # The kept one predicts poses it has not seen.
    elsewhere = replace(block, q=table.chain.random_values(len(block.q), np.random.default_rng(9)))
    true, found = (view(table, elsewhere, s)[block.valid] for s in (true_state(data), calibration.estimate))
    T = kabsch(found, true)
    assert np.abs(found @ T[:3, :3].T + T[:3, 3] - true).max() < 1e-6


def test_the_kept_solution_is_the_one_near_the_drawing(simulated: Callable) -> None:
    data = simulated("elbow3r")
    session = replace(data.session, estimate=Estimate("dh", "fixed", "fixed"))
    alone, among = calibrate(session), calibrate(session, starts=6)
    np.testing.assert_allclose(alone.placements, among.placements, atol=1e-7)
    assert len(among.to_dict()["solutions"]) == 7


def test_arms_that_differ_only_where_a_moving_arm_did_not_go_are_not_the_same(simulated: Callable) -> None:
    session = set_in_motion(simulated("ur5", poses=8), Motion()).session
    table = DHTable.from_chain(session.chain)
    drawn = start_state(session, table, np.zeros_like(table.nominal))
    other = replace(drawn, offsets=0.1 * (np.arange(5) == 0) * np.ones_like(table.nominal))
    log = session.trajectory.log  # of an arm that stayed where it was: any arm puts one LED there
    still = replace(log, values=np.broadcast_to(log.values[0], log.values.shape))
    blocks = observe(replace(session, trajectory=replace(session.trajectory, log=still)))
    a, b = (SimpleNamespace(state=state) for state in (drawn, other))
    assert _same_arm(table, blocks, a, a)
    assert not _same_arm(table, blocks, a, b)


def test_cameras_have_no_part_in_other_starts_from_points(simulated: Callable) -> None:
    session = replace(simulated("ur5").session, estimate=Estimate("dh", "fixed", "fixed"))
    calibration = calibrate(session, method="points", starts=2)
    states = [candidate.solution.state for candidate in calibration.solutions if candidate.solution]
    assert len(states) == 3
    assert not any(state.cameras for state in states)
    assert "rms_px" not in calibration.validation()  # whichever of the equal minima was kept
