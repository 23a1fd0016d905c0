"""What every block of an estimate must do: those of the general sessions, and of every registered kind."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.estimation.derivatives import STEPS
from tests.estimation.joint_models.test_joint_models import geometry_with, session_for
from tests.estimation.measurements.test_measurements import CASES, session_with
from tests.estimation.problems import Example, at_rest, branched, eye_in_hand, filmed
from urdfcal.cameras.camera import Camera
from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.base_pose import BaseBlock
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.measurements import Detections

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats
    from urdfcal.estimation.blocks.base import Block

GENERAL: dict[str, Callable] = {"at_rest": at_rest, "branched": branched, "eye_in_hand": eye_in_hand, "filmed": filmed}


def _examples() -> list[Any]:
    cases = [
        pytest.param((make, geometry), id=f"{name}-{geometry}")
        for name, make in GENERAL.items()
        for geometry in ("dh", "offsets", "full")
    ]
    cases += [pytest.param((case.values, "dh"), id=f"measurement-{case.id}") for case in CASES]
    return [*cases, *(pytest.param((model, None), id=f"joint_model-{model.name}") for model in JOINT_MODELS)]


@pytest.fixture(params=_examples())
def example(request: pytest.FixtureRequest, simulated: Callable) -> Example:
    what, geometry = request.param
    if isinstance(what, tuple):
        return Example.of(session_with(*what, simulated), geometry)
    if what in JOINT_MODELS:
        session = session_for(what, simulated)
        return Example.of(session, geometry_with(what, session))
    return Example.of(what(simulated), geometry)


def numbers(value: Any) -> Floats:
    """A block's value as an array."""
    return np.array(value.parameters if isinstance(value, Camera) else value, dtype=float)


def some_step(block: Block[Any], seed: int) -> Floats:
    """A random step of all coordinates, about 0.01 m or rad in effect, within the prior."""
    size = np.minimum(0.01 * block.scale(block.nominal), np.where(np.isfinite(block.sigma), block.sigma, np.inf))
    return size * np.random.default_rng(seed).normal(size=len(block))


def test_an_led_and_a_camera_of_one_name_are_refused(simulated: Callable) -> None:
    session = at_rest(simulated)
    led = replace(session.leds[0], name=session.rig.names[1])
    with pytest.raises(SessionError, match=r"two unknowns are named 'cam1\.x'"):
        Example.of(replace(session, leds=(led, *session.leds[1:])), "dh")


def test_names_units_and_standard_deviations_agree_in_number(example: Example) -> None:
    names = example.parameters.names
    assert len(set(names)) == len(names)
    keys = [block.key for block in example.parameters.blocks]
    assert len(set(keys)) == len(keys)
    for block in example.parameters.blocks:
        count = len(block)
        assert len(block.names) == len(block.units) == count, block.key.name
        assert all(block.names), block.key.name
        assert all(block.units), block.key.name
        assert block.sigma.shape == block.active.shape == (count,), block.key.name
        assert (block.sigma > 0.0).all(), block.key.name
        assert set(block.fixed) <= set(range(count)), block.key.name
        assert all(block.fixed.values()), block.key.name
        scale = block.scale(example.state[block.key])
        assert scale.shape == (count,), block.key.name
        assert (scale > 0.0).all(), block.key.name
        assert len({block.label(k) for k in range(count)}) == count, block.key.name
        assert len({block.priority(k) for k in range(count)}) == count, block.key.name
        sigma = np.where(block.active, 1.0, np.nan)
        entries = block.document(example.state[block.key], sigma)
        assert len(entries) == (0 if block.own_section else count), block.key.name


def test_a_step_of_zero_changes_nothing(example: Example) -> None:
    for block in example.parameters.blocks:
        value = example.state[block.key]
        moved = block.retract(value, np.zeros(len(block)))
        assert type(moved) is type(value), block.key.name
        np.testing.assert_array_equal(numbers(moved), numbers(value), err_msg=block.key.name)


def test_a_step_does_not_change_the_value_it_starts_from(example: Example) -> None:
    for block in example.parameters.blocks:
        value = example.state[block.key]
        before = numbers(value)
        moved = block.retract(value, some_step(block, 1))
        assert not np.array_equal(numbers(moved), before), block.key.name
        np.testing.assert_array_equal(numbers(value), before, err_msg=block.key.name)


def test_every_coordinate_moves_the_value_on_its_own(example: Example) -> None:
    # The derivative of the value by the coordinates has full rank: no two of them are the same.
    for block in example.parameters.blocks:
        value = block.retract(block.nominal, some_step(block, 2))
        columns = []
        for k in range(len(block)):
            step = np.zeros(len(block))
            step[k] = STEPS.get(block.units[k], 1e-6)
            before, after = (numbers(block.retract(value, sign * step)).ravel() for sign in (-1, 1))
            columns.append((after - before) / (2 * step[k]))
        assert np.linalg.matrix_rank(np.transpose(columns), tol=1e-6) == len(block), block.key.name


def test_coordinates_about_nominal_have_their_derivative(example: Example) -> None:
    for block in example.parameters.blocks:
        if isinstance(block, BaseBlock):
            continue  # it never has a prior, and so nothing to differ from
        at_nominal, J_nominal = block.local(block.nominal)
        np.testing.assert_allclose(at_nominal, 0.0, atol=1e-12, err_msg=block.key.name)
        np.testing.assert_allclose(J_nominal, np.eye(len(block)), atol=1e-9, err_msg=block.key.name)
        first = some_step(block, 3)
        value = block.retract(block.nominal, first)
        coordinates, J = block.local(value)
        np.testing.assert_allclose(coordinates, first, rtol=1e-9, atol=1e-9, err_msg=block.key.name)
        assert J.shape == (len(block), len(block)), block.key.name
        value = block.retract(value, some_step(block, 4))
        _, J = block.local(value)
        for k in range(len(block)):
            step = np.zeros(len(block))
            step[k] = STEPS.get(block.units[k], 1e-6)
            before, after = (block.local(block.retract(value, sign * step))[0] for sign in (-1, 1))
            np.testing.assert_allclose(J[:, k], (after - before) / (2 * step[k]), atol=1e-6, err_msg=block.names[k])


def test_where_the_robot_stands_has_no_prior(example: Example) -> None:
    (base,) = (block for block in example.parameters.blocks if isinstance(block, BaseBlock))
    assert np.isinf(base.sigma).all()


def test_more_coordinates_can_be_fixed(example: Example) -> None:
    for block in example.parameters.blocks:
        fixed = block.fixing({0: "a reason"})
        assert not fixed.active[0], block.key.name
        np.testing.assert_array_equal(fixed.active[1:], block.active[1:], err_msg=block.key.name)
        assert fixed.reasons[block.names[0]] == "a reason", block.key.name
        assert dict(fixed.reasons) == {**block.reasons, block.names[0]: "a reason"}, block.key.name


def test_the_packing_moves_each_block_by_its_own_part_of_the_step(example: Example) -> None:
    parameters, state = example.parameters, example.state
    step = 1e-4 * np.random.default_rng(5).normal(size=parameters.count)
    moved = parameters.retract(state, step)
    full = np.zeros(parameters.size)
    full[parameters.active] = step
    for block in parameters.blocks:
        expected = block.retract(state[block.key], full[parameters.columns(block.key)])
        np.testing.assert_array_equal(numbers(moved[block.key]), numbers(expected), err_msg=block.key.name)
    for key in state:
        if key not in {block.key for block in parameters.blocks}:
            assert moved[key] is state[key], key.name


def test_priors_of_all_blocks_have_their_derivative(example: Example) -> None:
    parameters, state = example.parameters, example.state
    _, J = parameters.prior_residuals(state)
    units = [unit for block in parameters.blocks for unit in block.units]
    for column, entry in enumerate(np.flatnonzero(parameters.active)):
        step = np.zeros(parameters.count)
        step[column] = min(STEPS.get(units[entry], 1e-6), parameters.prior[entry])
        before, after = (parameters.prior_residuals(parameters.retract(state, sign * step))[0] for sign in (-1, 1))
        numeric = (after - before) / (2 * step[column])
        scale = max(np.abs(numeric).max(), 1.0)
        assert np.abs(J[:, column] - numeric).max() < 1e-5 * scale, parameters.names[entry]


def test_a_pixel_in_a_lens_is_scaled_to_the_effect_of_a_radian(example: Example) -> None:
    # What identifiability compares columns by: unscaled, pixels would look hundreds of times as weak.
    parameters = example.parameters
    units = np.array([unit for block in parameters.blocks for unit in block.units])[parameters.active]
    scales = parameters.scales(example.state)[parameters.active]
    for observed in example.problem.observations:
        J = Tangent.at(example.problem, observed, example.state, parameters).linearise().J
        effect = scales * np.sqrt(np.mean(J.reshape(-1, parameters.count) ** 2, axis=0))
        largest = effect[units == "rad"].max()
        seen = (units == "px") & effect.astype(bool)
        assert seen.any() or not isinstance(observed.table, Detections)
        assert ((effect[seen] > 0.02 * largest) & (effect[seen] < 5.0 * largest)).all()
