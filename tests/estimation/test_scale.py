from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.derivatives import assert_derivatives
from tests.estimation.problems import Estimated, Example, at_rest
from tests.worlds import scaled
from urdfcal.estimation.blocks.scale import SCALE
from urdfcal.estimation.diagnosis.residuals import Unexplained, _everything
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.measurements import Points
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.estimation.noise import find_noise
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.scale import LengthScale, find_scale
from urdfcal.io.folder import read_session
from urdfcal.io.writing import write_session
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.session.model import Session


def scale_of(session: Session) -> tuple[Estimated, LengthScale]:
    found = Estimated.of(session)
    left = Unexplained.of(session, found.problem, found.fit, find_noise(found.problem, found.fit))
    return found, find_scale(found.problem, found.fit, left)


def as_points(session: Session) -> Session:
    found = triangulate(session)
    return replace(
        session, measurements=(Points(found.pose, found.led, found.xyz, np.array(session.noise.of(Points))),)
    )


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", ["ur5", "panda", "so101"])
def test_a_rig_that_is_too_long_comes_out_so_within_the_tolerances(rig: str, simulated: Callable) -> None:
    data = simulated(rig, poses=50)
    _, right = scale_of(data.session)
    assert right.sigmas < 3.0
    for share in (-0.01, 0.005):
        _, wrong = scale_of(scaled(data, share))
        # The arm's own offsets are the same: what is added is what the rig is too long by.
        assert wrong.factor - right.factor == pytest.approx(share, rel=0.02)
        assert wrong.sigma == pytest.approx(right.sigma, rel=0.05)


def test_a_permille_is_worth_what_it_does_to_the_tip(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    before, scale = scale_of(data.session)
    after, _ = scale_of(scaled(data, 1e-3))
    chain = data.session.chain
    arms = (chain.with_placements(of.placements) for of in (before, after))
    moved = compare(*arms, chain.random_values(300, np.random.default_rng(0))).position
    assert scale.tip_per_permille == pytest.approx(np.sqrt(np.mean(moved**2)), rel=0.02)


def test_one_camera_gives_no_length(simulated: Callable) -> None:
    _, scale = scale_of(simulated("ur5_handeye", poses=20).session)
    assert scale.tip_per_permille == 0.0
    assert scale.sigmas == 0.0
    assert np.isinf(scale.sigma)


def test_a_trackers_metre_is_a_scale_too(simulated: Callable) -> None:
    session = as_points(simulated("ur5", poses=50).session)
    (table,) = session.measurements
    _, right = scale_of(session)
    _, wrong = scale_of(replace(session, measurements=(replace(table, xyz=1.005 * table.xyz),)))
    assert wrong.factor - right.factor == pytest.approx(0.005, rel=0.05)
    assert wrong.tip_per_permille > 3e-4


@pytest.mark.parametrize("kind", ["pixels", "points"])
def test_its_derivative_is_that_of_the_residuals(kind: str, simulated: Callable) -> None:
    session = at_rest(simulated) if kind == "pixels" else as_points(at_rest(simulated))
    example = Example.of(session, "none")
    (observed,), state = example.problem.observations, example.state
    parameters = _everything(session, state)
    at = Tangent.at(example.problem, observed, state, parameters).linearise()
    derivative = at.J[..., parameters.columns(SCALE).start]
    assert derivative.any()
    step = 1e-6
    if kind == "points":  # too long a metre is too small a number, to first order of all residuals
        numeric = example.problem.predict(observed, state)
    else:
        key = next(block.key for block in example.parameters.blocks if block.key.name == "cam1.pose")

        def residual(share: float) -> np.ndarray:
            shrunk = np.array(state[key])
            shrunk[:3, 3] *= 1.0 - share
            return Problem.residual(example.problem, observed, state.replace({key: shrunk}))

        numeric = (residual(step) - residual(-step)) / (2.0 * step)
    np.testing.assert_allclose(derivative, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.parametrize("kind", ["pixels", "points"])
def test_measurements_have_their_derivatives_with_a_scale(kind: str, simulated: Callable) -> None:
    session = at_rest(simulated) if kind == "pixels" else as_points(at_rest(simulated))
    example = Example.of(replace(session, scale_sigma=0.02), "dh")
    assert "scale" in example.parameters.names
    state = example.state.replace({SCALE: np.array([0.013])})
    (observed,) = example.problem.observations
    assert_derivatives(example.problem, observed, state, example.parameters)


def test_a_scale_known_to_half_a_percent_is_found_and_is_in_the_interval(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    calibration = calibrate(replace(scaled(data, 0.007), scale_sigma=0.005, estimate=Estimate("dh")))
    scale, tip = calibration.evidence.scale, calibration.evidence.tip
    assert scale.declared == 0.005
    assert abs(scale.factor - 0.007) < 3.0 * scale.sigma
    assert calibration.assessment.level == "good"
    chain = data.session.chain
    arms = (chain.with_placements(of) for of in (data.truth.placements, calibration.placements))
    apart = compare(*arms, chain.random_values(300, np.random.default_rng(0))).position
    assert np.sqrt(np.mean(apart**2)) < tip.interval[1]
    assert tip.interval[1] > 1e-3  # ten times what it would be with the scale as given
    section = calibration.document.scale
    assert (section.declared_sigma, section.factor) == (0.005, scale.factor)


def test_a_scale_far_beyond_what_was_declared_is_a_warning(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    calibration = calibrate(replace(scaled(data, 0.02), scale_sigma=0.004, estimate=Estimate("dh")), force=True)
    assert any("all lengths come out" in reason for reason in calibration.assessment.reasons)


def test_an_exact_scale_is_as_given(simulated: Callable) -> None:
    session = simulated("ur5", poses=30).session
    a, b = (calibrate(replace(session, scale_sigma=sigma, estimate=Estimate("dh"))) for sigma in (None, 0.0))
    np.testing.assert_allclose(a.placements, b.placements, atol=1e-12)
    assert (a.evidence.scale.declared, b.evidence.scale.declared) == (None, 0.0)


def test_it_is_read_and_written(simulated: Callable, tmp_path: Path) -> None:
    write_session(tmp_path / "s", replace(simulated("ur5", poses=8).session, scale_sigma=0.002))
    assert "scale: {sigma: 0.002}" in (tmp_path / "s" / "session.yaml").read_text()
    assert read_session(tmp_path / "s").scale_sigma == 0.002
