from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.optimize import least_squares

from urdfcal.estimation.blocks.cameras import lens_key
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.projection import projection_sigma
from urdfcal.estimation.start import first_state
from urdfcal.robot.dh import DHTable
from urdfcal.rotations import rotation_vector_to_matrix

if TYPE_CHECKING:
    from collections.abc import Callable


def example(simulated: Callable, intrinsics: str) -> tuple[Problem, SimpleNamespace]:
    session = simulated("ur5").session
    table = DHTable.from_chain(session.chain)
    problem, state = Problem.of(session, table), first_state(session, table, np.zeros_like(table.nominal))
    spec = ModelSpec("dh", (intrinsics,) * 2, ("fixed",) * 2)
    return problem, SimpleNamespace(state=state, parameters=choose_parameters(session, problem, state, spec))


@pytest.mark.parametrize("parameter", ["fx", "cx", "k1"])
def test_it_is_what_a_lens_moves_pixels_by_once_the_camera_is_turned_to_fit(
    simulated: Callable, parameter: str
) -> None:
    problem, fit = example(simulated, "free")
    lens = fit.state[lens_key("cam0")]
    step = {"fx": 1e-2, "cx": 1e-2, "k1": 1e-5}[parameter]
    names = [name for name, on in zip(fit.parameters.names, fit.parameters.active, strict=True) if on]
    fit.covariance = np.diag([step**2 if name == f"cam0.{parameter}" else 0.0 for name in names])
    width, height = lens.resolution
    uv = np.stack(np.meshgrid(np.linspace(0, width, 9), np.linspace(0, height, 7)), axis=-1).reshape(-1, 2)
    rays = lens.unproject(uv)
    points = rays * (np.linspace(1.0, 2.0, len(uv)) / np.linalg.norm(rays, axis=1))[:, None]
    distance = np.linalg.norm(points, axis=1)
    seen = uv[:, 0] < 0.6 * width
    sigma = projection_sigma(problem, fit, 0, uv, uv[seen], distance[seen])
    assert sigma is not None
    values = np.array(lens.parameters)
    values[lens.parameter_names.index(parameter)] += step
    other = lens.with_parameters(values)

    def moved(motion: np.ndarray, of: np.ndarray) -> np.ndarray:
        shown = of @ rotation_vector_to_matrix(motion[:3]).T + motion[3:]
        return other.project(shown) - lens.project(of)

    motion = least_squares(lambda x: moved(x, points[seen]).ravel(), np.zeros(6), x_scale=1e-5).x
    middle = rays * (np.median(distance[seen]) / np.linalg.norm(rays, axis=1))[:, None]
    left = moved(motion, middle)
    if parameter == "cx":
        assert sigma[seen].max() < 0.5 * step  # most of a shift is a turn
    assert sigma[seen].mean() < sigma[~seen].mean()
    np.testing.assert_allclose(sigma, np.linalg.norm(left, axis=1), atol=0.02 * sigma.max())
    assert not np.any(projection_sigma(problem, fit, 1, uv, uv, distance))
    assert projection_sigma(problem, fit, 0, uv, uv[:0], distance[:0]) is None


def test_a_lens_that_is_not_estimated_has_none(simulated: Callable) -> None:
    problem, fit = example(simulated, "fixed")
    assert projection_sigma(problem, fit, 0, *2 * (np.zeros((1, 2)),), np.ones(1)) is None
