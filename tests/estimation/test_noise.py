from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from tests.worlds import declared
from urdfcal.estimation.noise import FoundNoise, _Likelihood, _Part, find_noise, noise_factors
from urdfcal.estimation.whitening import joint_noise

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session

estimated = cache(Estimated.of)


def noise_of(session: Session, undeclared: tuple[str, ...] = ()) -> dict[str, FoundNoise]:
    estimate = estimated(session)
    return {of.name: of for of in find_noise(estimate.problem, estimate.fit, undeclared)}


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", ["so101", "tiago", "panda"])
def test_the_noise_that_was_simulated_is_found(rig: str, simulated: Callable) -> None:
    session = simulated(rig, poses=50).session
    found = noise_of(session)
    assert list(found) == ["pixel", "joint"]
    for name, true in (("pixel", session.noise.pixel), ("joint", session.noise.joint)):
        assert found[name].declared == pytest.approx(true)
        assert abs(np.log(found[name].found / true)) < 4.0 * found[name].relative_sigma
        assert found[name].ratio == 1.0  # nothing contradicts what is declared
    assert found["pixel"].known
    assert (found["pixel"].unit, found["joint"].unit) == ("px", "rad")


@pytest.mark.parametrize(("pixel", "joint"), [(20.0, None), (0.2, None), (1.0, 0.05)])
def test_what_is_declared_does_not_change_what_is_found(pixel: float, joint: float | None, simulated: Callable) -> None:
    data = simulated("panda", poses=50)
    right, wrong = noise_of(data.session), noise_of(declared(data, 0.0, pixel, joint))
    for name in ("pixel", "joint"):
        # An estimate with other weights leaves other residuals, within its own error.
        assert wrong[name].found == pytest.approx(right[name].found, rel=0.05)
    assert wrong["pixel"].ratio == pytest.approx(pixel * right["pixel"].declared / right["pixel"].found, rel=0.05) or (
        pixel == 1.0 and wrong["pixel"].ratio == 1.0
    )
    if joint is not None:
        assert wrong["joint"].ratio > 100.0


@pytest.mark.no_cover
def test_nothing_declared_is_never_contradicted(simulated: Callable) -> None:
    data = simulated("so101", poses=50)
    found = noise_of(declared(data, 0.0, 1.0, 0.0), ("joint",))["joint"]
    assert found.declared is None
    assert found.ratio == 1.0
    assert noise_of(declared(data, 0.0, 1.0, 0.0))["joint"].ratio == 0.0  # declared to be none, and there is some


@pytest.mark.parametrize(("unit", "noise", "nothing"), [("px", 15.0, 25.0), ("m", 0.04, 0.06), ("rad", 0.08, 0.12)])
def test_of_what_size_residuals_are_no_noise(unit: str, noise: float, nothing: float) -> None:
    of = FoundNoise("kind", unit, None, noise, 0.1, 0.0)
    assert not of.is_none
    assert replace(of, found=nothing).is_none
    assert not replace(of, found=nothing, declared=nothing).is_none  # said to be so


def test_outliers_are_no_noise(simulated: Callable) -> None:
    clean = noise_of(simulated("panda", poses=50).session)["pixel"].found
    assert noise_of(simulated("panda", poses=50, outliers=0.1).session)["pixel"].found == pytest.approx(clean, rel=0.15)


@pytest.fixture
def likelihood(simulated: Callable) -> _Likelihood:
    estimate = estimated(simulated("so101", poses=20).session)
    problem, fit = estimate.problem, estimate.fit
    parts = [_Part.of(problem, fit, of, kept) for of, kept in zip(problem.observations, fit.kept, strict=True)]
    return _Likelihood(tuple(parts), *fit.parameters.prior_residuals(fit.state))


@pytest.mark.parametrize("meant", [None, 2.0 * np.log(1e-4)])
def test_score_and_observed_information_are_derivatives_of_the_likelihood(
    likelihood: _Likelihood, meant: float | None
) -> None:
    likelihood, variances = replace(likelihood, meant=meant), np.array([1.7, (3e-4) ** 2])
    here = likelihood.at(variances)
    for k in range(2):
        step = np.where(np.arange(2) == k, 1e-4, 0.0)
        before, after = (likelihood.at(variances * np.exp(sign * step)) for sign in (-1.0, 1.0))
        assert (after.value - before.value) / 2e-4 == pytest.approx(here.score[k], rel=1e-4, abs=1e-4)
        np.testing.assert_allclose((before.score - after.score) / 2e-4, here.observed[k], rtol=1e-4, atol=1e-4)


def test_the_information_is_that_of_the_whole_covariance(likelihood: _Likelihood) -> None:
    variances = np.array([1.7, (3e-4) ** 2])
    (part,) = likelihood.parts
    N, rows, p = part.J.shape
    J = part.J.reshape(N * rows, p)
    joint = np.zeros((N, rows, N, rows))
    joint[np.arange(N), :, np.arange(N), :] = part.joint @ np.swapaxes(part.joint, 1, 2)
    own = np.diag(np.ones(N * rows) * part.used.reshape(-1))
    shares = [variances[0] * own, variances[1] * joint.reshape(N * rows, N * rows)]
    inverse = np.linalg.pinv(sum(shares))
    covariance = np.linalg.pinv(J.T @ inverse @ J + likelihood.J_prior.T @ likelihood.J_prior)
    P = inverse - inverse @ J @ covariance @ J.T @ inverse
    expected = [[0.5 * np.trace(P @ a @ P @ b) for b in shares] for a in shares]
    np.testing.assert_allclose(likelihood.at(variances).information, expected, rtol=1e-6)


def test_the_likeliest_variances_are_found_in_a_few_rounds(
    likelihood: _Likelihood, monkeypatch: pytest.MonkeyPatch
) -> None:
    variances, evaluations, at = np.array([1.7, (3e-4) ** 2]), [], _Likelihood.at
    monkeypatch.setattr(_Likelihood, "at", lambda self, of: evaluations.append(of) or at(self, of))
    best, _ = likelihood.maximise(variances)
    assert len(evaluations) <= 10  # Fisher's scoring takes thirty
    np.testing.assert_allclose(likelihood.at(best).score, 0.0, atol=1e-3)
    held, _ = likelihood.maximise(variances, hold=1)
    assert held[1] == variances[1]
    assert held[0] != variances[0]


def test_steps_that_lead_downwards_are_not_taken(likelihood: _Likelihood, monkeypatch: pytest.MonkeyPatch) -> None:
    at, variances = _Likelihood.at, np.array([1.7, (3e-4) ** 2])
    expected, _ = likelihood.maximise(variances)

    def flat(self: _Likelihood, of: np.ndarray) -> object:
        here = at(self, of)
        return replace(here, observed=0.05 * here.information)  # as if steps had to be twenty times as long

    monkeypatch.setattr(_Likelihood, "at", flat)
    found, _ = likelihood.maximise(variances)
    np.testing.assert_allclose(found, expected, rtol=0.05)


def test_noise_of_joints_that_move_nothing_that_is_seen_is_unknown(
    simulated: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(*arguments: object) -> np.ndarray:
        return 0.0 * joint_noise(*arguments)

    estimate = estimated(simulated("so101", poses=20).session)
    monkeypatch.setattr("urdfcal.estimation.noise.joint_noise", nothing)
    pixel, joint = find_noise(estimate.problem, estimate.fit)
    assert pixel.known
    assert not joint.known
    assert joint.ratio == 1.0


def test_the_quick_way_finds_the_same_noise(simulated: Callable) -> None:
    estimate = estimated(simulated("ur5", poses=40).session)
    problem, fit = estimate.problem, estimate.fit
    *kinds, joint = find_noise(problem, fit)
    *factors, quick = noise_factors(problem, fit)
    assert quick == joint.found
    assert factors == pytest.approx([of.found / 0.1 for of in kinds], rel=1e-9)
