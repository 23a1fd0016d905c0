from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.calibration import calibrate
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.freedoms import Freedoms
from urdfcal.estimation.observations import observe
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.solver import solve
from urdfcal.robot.dh import DHTable
from urdfcal.session.model import Noise

if TYPE_CHECKING:
    from collections.abc import Callable


def noise_free(data: object, true_state: Callable) -> object:
    """The session's sightings replaced by what the true robot shows, with true joint readings."""
    from urdfcal.estimation.residuals import predict

    session = replace(data.session, q=data.truth.q)
    table = DHTable.from_chain(session.chain)
    (block,) = observe(session)
    uv = block.by_row(predict(table, block, true_state(data)))
    return replace(session, detections=replace(session.detections, uv=uv), noise=Noise(0.1, 1e-4, 0.0))


@pytest.mark.parametrize("rig", ["elbow3r", "ur5", "panda", "so101", "stanford"])
def test_noise_free_sightings_give_the_truth(rig: str, simulated: Callable, true_state: Callable) -> None:
    data = simulated(rig)
    session = noise_free(data, true_state)
    free = replace(session, leds=tuple(replace(led, position=None, sigma=None) for led in session.leds))
    calibration = calibrate(free, priors=False)
    # Tips, not placements: what only ever appears as a sum may be shared out differently.
    q = session.chain.random_values(100, np.random.default_rng(0))
    true, found = (replace(session.chain, placements=p) for p in (data.truth.placements, calibration.placements))
    assert compare(true, found, q).position.max() < 1e-7
    np.testing.assert_allclose(calibration.estimate.leds, data.truth.leds, atol=1e-7)
    assert calibration.summary()["rms_px"] < 1e-5


def test_the_order_of_poses_does_not_matter(simulated: Callable) -> None:
    session = simulated("ur5").session
    d = session.detections
    order = np.random.default_rng(0).permutation(len(session.poses))
    place = np.argsort(order)
    sorting = np.lexsort((d.led, d.camera, place[d.pose]))
    shuffled = replace(
        session,
        poses=tuple(session.poses[k] for k in order),
        q=session.q[order],
        time=None,
        detections=type(d)(place[d.pose][sorting], d.camera[sorting], d.led[sorting], d.uv[sorting], d.sigma[sorting]),
    )
    a, b = calibrate(session), calibrate(shuffled)
    np.testing.assert_allclose(a.placements, b.placements, atol=1e-9)
    np.testing.assert_allclose(a.sigmas(), b.sigmas(), rtol=1e-6)


def test_moved_sightings_are_found_and_left_out(simulated: Callable) -> None:
    clean, dirty = simulated("ur5", poses=40), simulated("ur5", poses=40, outliers=0.1)
    moved = {
        (int(dirty.session.detections.pose[k]), int(dirty.session.detections.camera[k])) for k in dirty.truth.outliers
    }
    assert len(moved) >= 6
    calibration = calibrate(dirty.session)
    names = calibration.session.rig.names
    found = {(calibration.session.poses.index(o["pose"]), names.index(o["camera"])) for o in calibration.outliers()}
    assert found == moved
    apart = np.abs(calibrate(clean.session).placements - calibration.placements)
    assert apart.max() < 5e-4


def test_a_held_parameter_does_not_move(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r")
    table, blocks = DHTable.from_chain(data.session.chain), observe(data.session)
    state = true_state(data)
    parameters = choose_parameters(data.session, table, state, Freedoms("dh", ("fixed",) * 2, ("fixed",) * 2)).holding(
        {0: "test", 1: "test"}
    )
    fit = solve(table, blocks, parameters.move(state, np.full(parameters.count, 1e-4)), parameters, 0.0)
    row, column = parameters.rows[0][0], 0
    assert fit.state.offsets[row, column] == state.offsets[row, column]
    assert fit.parameters.count == parameters.size - 2


def test_the_cost_never_rises_within_a_stage(simulated: Callable) -> None:
    history = calibrate(simulated("panda").session).fit.history
    assert history[-1].step < 1e-6
    assert history[-1].cost <= history[-2].cost * (1 + 1e-9)


def test_standard_deviations_are_true(simulated: Callable) -> None:
    # Whitened errors of all estimated offsets over a few runs: mean square 1 within what chance allows.
    squares = []
    for seed in range(12):
        data = simulated("elbow3r", poses=20, seed=seed)
        free = replace(data.session, leds=tuple(replace(led, position=None, sigma=None) for led in data.session.leds))
        calibration = calibrate(free, priors=False)
        sigma = calibration.sigmas()
        known = np.isfinite(sigma)
        squares.append((((calibration.estimate.offsets - data.truth.offsets) / sigma)[known]) ** 2)
    mean = np.mean(np.concatenate(squares))
    assert 0.6 < mean < 1.5
