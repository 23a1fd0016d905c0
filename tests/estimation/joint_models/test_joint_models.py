"""What every joint model must do, whatever it models.

A new one is tested here on the first of ``GENERAL`` that it applies to; one that applies to none of them needs an entry
in ``SESSIONS``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.derivatives import STEPS, assert_derivatives
from tests.estimation.problems import Example, at_rest, filmed
from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.joint_models import JOINT_MODELS, JointModel, Readings
from urdfcal.estimation.joint_models.compliance import Compliance
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.joint_models.torque_basis import TorqueBasis
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.problem import Problem
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.knowledge import Estimate, Payload

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats
    from urdfcal.session.model import Session

GENERAL: tuple[Callable[[Callable], Session], ...] = (at_rest, filmed)
"""Sessions that most models apply to: an arm at rest, and a moving one."""


def geared(simulated: Callable) -> Session:
    """An arm with gears of known ratio."""
    session = at_rest(simulated)
    return replace(session, gear_ratio={session.chain.names[0]: 121.0, session.chain.names[3]: 50.0})


def without_urdf(simulated: Callable) -> Session:
    """An arm of which nobody knows what it weighs."""
    return replace(at_rest(simulated), urdf=None)


def leaning(simulated: Callable) -> Session:
    """An arm whose base leans, nobody knows where to."""
    return replace(at_rest(simulated), estimate=Estimate(gravity="free"))


SESSIONS: dict[str, Callable[[Callable], Session]] = {
    "motor_harmonics": geared,
    "torque_basis": without_urdf,
    "leaning_compliance": leaning,
}
"""By name, a session for a model that applies to none of these, made from the fixture ``simulated``."""

LINEAR = tuple(model for model in JOINT_MODELS if issubclass(model, LinearJointModel))

# Parameters away from nominal by this share of their standard deviation, or by this much if they have none.
_SHARE, _WITHOUT_PRIOR = 0.02, 1e-3


def session_for(model: type[JointModel], simulated: Callable) -> Session:
    """A session that a model applies to, with the model on."""
    makers = (SESSIONS[model.name],) if model.name in SESSIONS else GENERAL
    for make in makers:
        session = replace(make(simulated), joint_models={model.name: True})
        if model.of(session) is not None:
            return session
    pytest.fail(
        f"{model.__name__} applies to no session: add a function to SESSIONS in {__file__} under {model.name!r} which "
        "returns one that it applies to"
    )


@pytest.fixture(params=JOINT_MODELS, ids=lambda model: model.name)
def kind(request: pytest.FixtureRequest) -> type[JointModel]:
    return request.param


@pytest.fixture
def session(kind: type[JointModel], simulated: Callable) -> Session:
    return session_for(kind, simulated)


@pytest.fixture
def model(kind: type[JointModel], session: Session) -> JointModel:
    return kind.of(session)


@pytest.fixture
def readings(session: Session) -> Readings:
    return Problem.of(session, rows_of(session.chain)).observations[0].readings


def some_value(model: JointModel) -> Floats:
    """A value that is not nominal in any coordinate."""
    size = np.where(np.isfinite(model.sigma), _SHARE * model.sigma, _WITHOUT_PRIOR)
    size = size * np.random.default_rng(0).uniform(0.5, 1.0, len(model))
    return model.retract(model.nominal, size)


def geometry_with(kind: type[JointModel], session: Session) -> str:
    """An arm's geometry that the model is estimated with."""
    return next(geometry for geometry in ("dh", "offsets", "full", "none") if kind.estimated(session, geometry))


def test_models_differ_in_name_and_key(simulated: Callable) -> None:
    names = [model.name for model in JOINT_MODELS]
    keys = [model.of(session_for(model, simulated)).key for model in JOINT_MODELS]
    assert len(set(names)) == len(set(keys)) == len(JOINT_MODELS)


def test_at_its_nominal_value_it_adds_nothing(model: JointModel, session: Session, readings: Readings) -> None:
    added = model.values(readings, model.nominal)
    assert np.shape(added) == readings.q.shape
    np.testing.assert_allclose(added, 0.0, atol=1e-12)
    arm = rows_of(session.chain)
    offsets = model.offsets(arm, model.nominal)
    assert offsets.shape == (len(arm.labels), len(arm.columns))
    assert not offsets.any()


def test_away_from_nominal_it_adds_something(model: JointModel, readings: Readings) -> None:
    assert np.isfinite(model.values(readings, some_value(model))).all()
    assert np.asarray(model.values(readings, some_value(model))).any()


def test_what_is_the_same_at_every_pose_is_held_by_the_arm_itself(model: JointModel, session: Session) -> None:
    # A corrected URDF has no joint models: it must move as the arm does with them.
    example = Example.of(session, "dh")
    readings = example.problem.observations[0].readings
    nominal = {of.key: of.nominal for of in example.problem.joint_models}
    state = example.start.replace({**nominal, model.key: some_value(model)})
    offsets = example.problem.offsets(state)
    if np.ptp(model.values(readings, state[model.key]), axis=0).any():
        np.testing.assert_array_equal(offsets, state[ARM] + model.offsets(example.problem.arm, state[model.key]))
        return
    expected, without, held = (
        example.problem.links(readings, at)
        for at in (state, state.replace(nominal), state.replace({**nominal, ARM: offsets}))
    )
    assert np.abs(np.array(without.p) - expected.p).max() > 1e-6
    np.testing.assert_allclose(held.R, expected.R, atol=1e-12)
    np.testing.assert_allclose(held.p, expected.p, atol=1e-12)


def test_its_jacobian_agrees_with_finite_differences(model: JointModel, readings: Readings) -> None:
    p, shape = some_value(model), (*readings.q.shape, len(model))
    J = np.broadcast_to(model.jacobian(readings, p), shape)
    assert J.any()
    for k in range(len(model)):
        step = np.zeros(len(model))
        step[k] = STEPS.get(model.units[k], 1e-6)
        before, after = (model.values(readings, model.retract(p, sign * step)) for sign in (-1, 1))
        numeric = (after - before) / (2 * step[k])
        assert np.abs(J[..., k] - numeric).max() < 1e-5 * max(np.abs(numeric).max(), 1e-3), model.names[k]


def test_its_derivative_by_the_readings_agrees_with_finite_differences(model: JointModel, readings: Readings) -> None:
    if not isinstance(model, LinearJointModel):
        return
    p, n = some_value(model), readings.q.shape[1]
    readings = readings.at(slice(1, None))  # the first pose came from nowhere: there play has a step
    found = np.broadcast_to(model.derivative(readings, p), (*readings.q.shape, n))
    for j in range(n):
        step = 1e-5 * np.eye(n)[j]
        before, after = (model.values(replace(readings, q=readings.q + sign * step), p) for sign in (-1, 1))
        np.testing.assert_allclose(found[..., j], (after - before) / 2e-5, atol=1e-6 * max(np.abs(found).max(), 1e-3))


def test_poses_do_not_depend_on_each_other(model: JointModel, readings: Readings) -> None:
    # Poses are evaluated part by part.
    p, some = some_value(model), np.arange(len(readings.q))[1::2]
    np.testing.assert_allclose(model.values(readings.at(some), p), model.values(readings, p)[some], atol=1e-14)
    shape = (*readings.q.shape, len(model))
    part = np.broadcast_to(model.jacobian(readings.at(some), p), (len(some), *shape[1:]))
    np.testing.assert_allclose(part, np.broadcast_to(model.jacobian(readings, p), shape)[some], atol=1e-14)


def test_of_no_readings_there_are_no_values(model: JointModel, readings: Readings) -> None:
    # A fold of the cross-validation may hold no measurement of a kind.
    none = readings.at(np.zeros(0, dtype=np.intp))
    assert np.shape(model.values(none, some_value(model))) == (0, readings.q.shape[1])
    J = np.broadcast_to(model.jacobian(none, some_value(model)), (0, readings.q.shape[1], len(model)))
    assert J.size == 0


def test_measurements_have_their_derivatives_by_its_parameters(
    kind: type[JointModel], model: JointModel, session: Session
) -> None:
    example = Example.of(session, geometry_with(kind, session))
    parameters = example.parameters
    where, active = parameters.active_columns(model.key)
    assert active.any()
    columns = range(where.start, where.stop)
    for observed in example.problem.observations:
        at = Tangent.at(example.problem, observed, example.state, parameters).linearise()
        assert at.J[..., where].any()
        assert_derivatives(example.problem, observed, example.state, parameters, columns, tolerance=2e-6)


def test_its_parameters_take_part_where_the_session_asks_for_them(
    kind: type[JointModel], model: JointModel, session: Session
) -> None:
    parameters = Example.of(session, geometry_with(kind, session)).parameters
    assert parameters.names[parameters.columns(model.key)] == model.names
    without = [geometry for geometry in ("dh", "offsets", "full", "none") if not kind.estimated(session, geometry)]
    for geometry in without:
        parameters = Example.of(session, geometry).parameters
        assert not parameters.has_active(model.key)


def test_one_that_is_switched_on_and_does_not_apply_is_refused(simulated: Callable) -> None:
    session = replace(at_rest(simulated), joint_models={"time_offset": True})
    with pytest.raises(SessionError, match="time_offset is switched on, but what it depends on is not in this session"):
        Problem.of(session, rows_of(session.chain))
    assert Problem.of(replace(session, joint_models={"time_offset": False}), rows_of(session.chain))


def test_what_is_no_matter_of_single_joints_is_refused_for_one(simulated: Callable) -> None:
    session = at_rest(simulated)
    session = replace(session, joint_models={"zero_offset": {session.chain.names[0]: True}})
    with pytest.raises(SessionError, match="zero_offset is not a matter of single joints"):
        Problem.of(session, rows_of(session.chain))
    with pytest.raises(SessionError, match="joint_9"):
        replace(session, joint_models={"gain": {"joint_9": True}})


@pytest.mark.parametrize("geometry", ["none", "offsets", "dh"])
def test_what_the_session_says_of_a_model_overrules_its_default(geometry: str, simulated: Callable) -> None:
    class Asked(JointModel):
        """A model that is estimated where it is asked for."""

        name = "asked"

    session = simulated("elbow3r", poses=8).session
    for kind in (*JOINT_MODELS, Asked):
        on, off = (replace(session, joint_models={kind.name: said}) for said in (True, False))
        assert kind.estimated(session, geometry) == kind.enabled(session, geometry)
        assert kind.estimated(on, geometry) >= kind.enabled(session, geometry)
        assert not kind.estimated(off, geometry)
    on = replace(session, joint_models={"asked": True})
    assert Asked.estimated(on, geometry) == (geometry != "none")


def test_where_torques_are_measured_a_joint_yields_to_them(simulated: Callable) -> None:
    session = simulated("panda", poses=8).session
    torques = np.random.default_rng(0).normal(size=session.q.shape)
    model = Compliance.of(replace(session, torques=torques))
    readings = Readings.of(replace(session, torques=torques))
    np.testing.assert_allclose(model.values(readings, np.full(7, 1e-5)), -1e-5 * torques)
    with pytest.raises(SessionError, match="measured torques, and these readings have none"):
        model.values(Readings.of(session), np.full(7, 1e-5))


def test_gravity_and_payload_are_those_of_the_session(simulated: Callable) -> None:
    session = simulated("panda", poses=8).session
    p = np.full(7, 1e-5)

    def values(**changes: object) -> Floats:
        changed = replace(session, **changes)
        return Compliance.of(changed).values(Readings.of(changed), p)

    upright = values()
    np.testing.assert_allclose(values(gravity=-session.gravity), -upright)  # hung from the ceiling
    assert np.abs(values(gravity=np.array([9.81, 0.0, 0.0])) - upright).max() > 1e-5
    assert np.abs(values(payload=Payload("panda_hand", 2.0, np.zeros(3))) - upright).max() > 1e-5


def test_whatever_a_robot_weighs_its_torques_are_in_the_basis(simulated: Callable) -> None:
    session = simulated("panda", poses=40).session
    known = Compliance.of(session)
    unknown = TorqueBasis.of(replace(session, urdf=None))
    readings = Readings.of(session)
    assert TorqueBasis.of(session) is None
    torques, basis = known.features(readings), unknown.features(readings)
    for j, joint in enumerate(session.chain.names):
        mine = basis[:, unknown.of_joints([joint])]
        rest = torques[:, j] - mine @ np.linalg.lstsq(mine, torques[:, j], rcond=None)[0]
        assert np.abs(rest).max() <= 0.05 * np.abs(torques).max()


def test_a_mimic_joint_follows_its_master_in_a_joint_model_too(simulated: Callable) -> None:
    session = simulated("so101", poses=8).session
    session = replace(session, gear_ratio=dict.fromkeys(session.chain.actuated, 50.0))
    for model in filter(None, (kind.of(session) for kind in LINEAR)):
        values = model.values(Readings.of(session), some_value(model))
        np.testing.assert_allclose(
            values, session.chain.readings(values) @ session.chain.reading_jacobian.T, atol=1e-15
        )


def test_where_an_arm_came_from_is_the_pose_before_unless_it_is_said(simulated: Callable) -> None:
    session = simulated("panda", poses=8).session
    np.testing.assert_array_equal(Readings.of(session).previous[1:], session.q[:-1])
    some = session.at(np.array([0, 2, 5]))
    np.testing.assert_array_equal(some.came_from, session.q[[0, 1, 4]])
    said = replace(session, previous=session.q[::-1])
    np.testing.assert_array_equal(Readings.of(said).at(slice(2, 4)).previous, session.q[::-1][2:4])


@pytest.mark.parametrize("kind", LINEAR)
def test_one_pose_at_a_time_is_as_many(kind: type[LinearJointModel], simulated: Callable) -> None:
    session = session_for(kind, simulated)
    model = kind.of(session)
    assert model is not None
    readings, p = Readings.of(session), 1e-4 * np.random.default_rng(0).normal(size=len(model))
    one, values, slopes = model.of_one(p), model.values(readings, p), model.derivative(readings, p)
    slopes = np.broadcast_to(slopes, (*values.shape, values.shape[1]))
    for k in range(3):
        alone = readings.at(np.array([k]))
        np.testing.assert_allclose(one.values(alone), values[k], atol=1e-15)
        np.testing.assert_allclose(one.slopes(alone), slopes[k], atol=1e-15)
