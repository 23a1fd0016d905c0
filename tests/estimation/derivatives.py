"""Derivatives checked against finite differences, block by block."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.linearize import Tangent

if TYPE_CHECKING:
    from collections.abc import Iterable

    from urdfcal.arrays import Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.state import State

# Where rounding and curvature are both below 1e-6 of a derivative. [unit of the parameter]
STEPS = {"m": 1e-6, "rad": 1e-6, "px": 1e-5, "s": 1e-5, "s/row": 1e-8, "1": 1e-6}


def units_of(parameters: Parameters) -> list[str]:
    """Unit of each active parameter."""
    units = [unit for block in parameters.blocks for unit in block.units]
    return [unit for unit, active in zip(units, parameters.active, strict=True) if active]


def names_of(parameters: Parameters) -> list[str]:
    """Name of each active parameter."""
    return [name for name, active in zip(parameters.names, parameters.active, strict=True) if active]


def numeric_derivative(
    problem: Problem, observed: Observations, state: State, parameters: Parameters, k: int
) -> Floats:
    """Derivative (N, m, D) of the prediction by an active parameter; zero where a slot is padding."""
    step = np.zeros(parameters.count)
    step[k] = STEPS.get(units_of(parameters)[k], 1e-6)
    before, after = (problem.residual(observed, parameters.retract(state, sign * step)) for sign in (-1, 1))
    return (after - before) / (2 * step[k])


def assert_derivatives(
    problem: Problem,
    observed: Observations,
    state: State,
    parameters: Parameters,
    only: Iterable[int] | None = None,
    tolerance: float = 1e-6,
) -> None:
    """Compare the derivatives by every active parameter, or some of them, with finite differences.

    They agree to ``tolerance`` of the largest one, or of 1 px (1 m) a metre or radian: less is nothing.
    """
    at = Tangent.at(problem, observed, state, parameters).linearise()
    np.testing.assert_allclose(at.residual, problem.residual(observed, state), rtol=0.0, atol=1e-9)
    names = names_of(parameters)
    for k in range(parameters.count) if only is None else only:
        numeric = numeric_derivative(problem, observed, state, parameters, k)
        scale = max(np.abs(numeric).max(), 1.0)
        assert np.abs(at.J[..., k] - numeric).max() < tolerance * scale, names[k]
