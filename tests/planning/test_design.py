from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from urdfcal.arrays import covariance_of
from urdfcal.planning.design import Candidates, choose


def problem(count: int = 9, seed: int = 0) -> tuple[Candidates, np.ndarray]:
    rng = np.random.default_rng(seed)
    factors = rng.standard_normal((count, 2, 5)) * rng.uniform(0.3, 3.0, (count, 1, 1))
    known = np.diag(rng.uniform(0.1, 2.0, 5))
    return Candidates(factors, rng.standard_normal((5, 4))), known


def test_a_gain_is_what_the_squared_error_falls_by() -> None:
    candidates, known = problem()
    before = candidates.error(known) ** 2
    falls = [before - candidates.error(known + candidates.information([k])) ** 2 for k in range(9)]
    np.testing.assert_allclose(candidates.gains(known), falls, rtol=1e-9)


def test_units_of_the_parameters_do_not_matter() -> None:
    candidates, known = problem()
    unit = np.array([1.0, 1e3, 1e-4, 10.0, 1e6])
    other = Candidates(candidates.factors * unit, candidates.tip * unit[:, None])
    known_other = known * np.outer(unit, unit)
    np.testing.assert_allclose(other.gains(known_other), candidates.gains(known), rtol=1e-8)
    np.testing.assert_allclose(covariance_of(known_other) * np.outer(unit, unit), covariance_of(known), rtol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_the_choice_is_nearly_the_best_of_all(seed: int) -> None:
    candidates, known = problem(seed=seed)
    chosen = choose(candidates, known, 4)
    errors = [candidates.error(known + candidates.information(some)) for some in combinations(range(9), 4)]
    assert len(set(chosen)) == 4
    assert candidates.error(known + candidates.information(chosen)) <= 1.02 * min(errors)


def test_what_is_not_free_is_not_chosen() -> None:
    candidates, known = problem()
    asked: list[int] = []

    def allowed(k: int) -> bool:
        asked.append(k)
        return k % 2 == 0

    assert set(choose(candidates, known, 9, allowed=allowed)) == {0, 2, 4, 6, 8}
    asked.clear()
    choose(candidates, known, 1, allowed=allowed)
    best = np.argsort(-candidates.gains(known))
    assert asked[: len(asked) // 2 + 1] == best[: len(asked) // 2 + 1].tolist()  # the others are not looked at
    assert len(asked) < 9


def test_no_more_are_chosen_than_reach_an_error() -> None:
    candidates, known = problem()
    _, likely = candidates.course(known, choose(candidates, known, 9))
    until = float(likely[4])
    enough = choose(candidates, known, 9, until=until)
    _, reached = candidates.course(known, enough)
    assert len(enough) <= 4
    assert reached[-1] <= until < reached[-2]
    assert choose(candidates, known, 9, until=2.0 * float(likely[0])) == ()


def test_nine_errors_in_ten_are_within_what_is_likely() -> None:
    candidates, known = problem()
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(5), covariance_of(known), 20_000)
    errors = np.linalg.norm(draws @ candidates.tip, axis=1)
    assert np.mean(errors <= candidates.likely(known)) == pytest.approx(0.9, abs=0.015)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(candidates.error(known), rel=0.02)
