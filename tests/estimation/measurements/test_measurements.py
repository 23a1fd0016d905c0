"""What every kind of measurement must do, whatever it measures.

A new kind is tested here on an invented session, in which every LED is measured once in every pose, by turns with
three things of its own; one that can make nothing of that needs an entry in ``SESSIONS``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from tests.estimation.derivatives import assert_derivatives
from tests.estimation.problems import Example, at_rest, branched, eye_in_hand
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.linearize import Jacobian, Tangent
from urdfcal.estimation.links import Links
from urdfcal.estimation.measurements import MEASUREMENTS, Measurement, Points, Poses
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.io.folder import read_session
from urdfcal.io.tables import read_measurements
from urdfcal.io.writing import write_measurements, write_session
from urdfcal.robot.kinematics import tip_poses
from urdfcal.rotations import matrix_to_quaternion
from urdfcal.session.pattern import FramePattern
from urdfcal.session.target import Target

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.session.model import Session

_THINGS = 3
GEOMETRIES = ("dh", "offsets", "full", "none")


def points(simulated: Callable) -> Session:
    """A tracker's points in place of two cameras' detections."""
    session = at_rest(simulated)
    found = triangulate(session)
    return replace(
        session, measurements=(Points(found.pose, found.led, found.xyz, np.array(session.noise.of(Points))),)
    )


def poses(simulated: Callable) -> Session:
    """A tracker's poses of a body on the last link, and of one on the first that moves, in place of detections."""
    session = at_rest(simulated)
    tips = (session.chain.tip_link,)
    targets = tuple(Target(f"body{k}", FramePattern(), link) for k, link in enumerate(tips * 2))
    session = replace(session, targets=targets)
    count, rng = len(session.poses), np.random.default_rng(0)
    T_world_base = pin.exp6(np.array([0.5, -0.3, 1.0, 0.3, 0.8, -0.5])).homogeneous
    fastened = [pin.exp6(0.2 * rng.normal(size=6)).homogeneous for _ in targets]
    T = T_world_base @ tip_poses(session.chain, session.q)
    places = np.array(
        [[*(M := T[k] @ X)[:3, 3], *matrix_to_quaternion(M[:3, :3])] for k in range(count) for X in fastened]
    )
    pose, target = np.divmod(np.arange(count * len(targets)), len(targets))
    usual = session.noise.spreads(Poses)
    return replace(session, measurements=(Poses(pose, target, places, **{k: np.array(v) for k, v in usual.items()}),))


SESSIONS: dict[str, tuple[Callable[[Callable], Session], ...]] = {
    "detections": (branched, eye_in_hand),
    "points": (points,),
    "poses": (poses,),
}
"""By kind, functions that make a session with measurements of it from the fixture ``simulated``.

It is a simulated session or made of one (it has a URDF), its values near what the nominal robot predicts, at eight
poses or so. It may have measurements of other kinds as well, if they are needed to place the robot.
"""


def invented(kind: type[Measurement], simulated: Callable) -> Session:
    """Beside two cameras' detections, one measurement of each LED in each pose by each camera, if it has to do with it.

    What the nominal robot predicts is measured, of three things by turns where the table names such.
    """
    session = branched(simulated)
    counts = {"pose": len(session.poses), "led": len(session.leds), "camera": len(session.rig.cameras)}
    known = [key for key in kind.keys if key in counts]
    index = dict(zip(known, np.indices([counts[key] for key in known]).reshape(len(known), -1), strict=True))
    rows = np.arange(index["pose"].size)
    own = {key: rows % _THINGS for key in kind.keys if key not in counts}
    names = {key: tuple(f"{key}{thing}" for thing in range(_THINGS)) for key in own}
    zero = {kind.array: np.zeros((len(rows), kind.dimension))} if kind.array else {}
    table = kind(**index, **own, **zero, sigma=np.array(kind.usual), names=names)
    session = replace(session, measurements=(*session.measurements, table))
    if not kind.array:
        return session
    example = Example.of(session, "none")
    observed = observed_of(example, kind)
    values = observed.by_row(example.problem.predict(observed, example.start))
    return replace(session, measurements=(*session.measurements[:-1], replace(table, **{kind.array: values})))


CASES = [
    pytest.param(kind, make, id=f"{kind.kind}-{make.__name__}")
    for kind in MEASUREMENTS
    for make in SESSIONS.get(kind.kind, (invented,))
]
each_kind = pytest.mark.parametrize(("kind", "make"), CASES)
"""Run a test on every kind with each of its sessions."""


def session_with(kind: type[Measurement], make: Callable, simulated: Callable) -> Session:
    """A session with measurements of a kind."""
    session = invented(kind, simulated) if make is invented else make(simulated)
    if session.find(kind) is None:
        pytest.fail(f"the session that SESSIONS in {__file__} gives for {kind.kind!r} has no {kind.__name__}")
    return session


@pytest.fixture
def session(kind: type[Measurement], make: Callable, simulated: Callable) -> Session:
    return session_with(kind, make, simulated)


def observed_of(example: Example, kind: type[Measurement]) -> Observations:
    return next(observed for observed in example.problem.observations if isinstance(observed.table, kind))


def jacobian_for(example: Example, observed: Observations) -> Jacobian:
    return Jacobian(example.parameters, observed.row.size, observed.dimension)


def assert_same_table(found: Measurement, expected: Measurement) -> None:
    """Same rows, to the last bit; things that only the table names may be numbered otherwise."""
    assert type(found) is type(expected)
    assert len(found) == len(expected)

    def rows(table: Measurement) -> list[tuple]:
        index = [
            [table.names[key][i] for i in column] if key in table.names else column.tolist()
            for key, column in table.index.items()
        ]
        return sorted(
            zip(
                *index,
                map(tuple, table.values.tolist()),
                *(getattr(table, name).tolist() for name in table.spread_of()),
                strict=True,
            )
        )

    assert rows(found) == rows(expected)


def test_kinds_differ_in_what_files_call_them() -> None:
    for what in ("kind", "noise"):
        names = [getattr(kind, what) for kind in MEASUREMENTS]
        assert len(set(names)) == len(names)
    assert set(SESSIONS) <= {kind.kind for kind in MEASUREMENTS}


@each_kind
def test_its_columns_and_numbers_agree(kind: type[Measurement], session: Session) -> None:
    table = session.find(kind)
    assert kind.keys[0] == "pose"
    assert bool(kind.columns) == bool(kind.array)
    assert table.values.shape == (len(table), len(kind.columns) or kind.dimension)
    assert table.compared.shape == (len(table), kind.dimension)
    assert table.covariances.shape == (len(table), kind.dimension, kind.dimension)
    assert (np.linalg.eigvalsh(table.covariances) > 0.0).all()
    assert kind.usual > 0.0
    assert kind.report[1] > 0.0


@each_kind
@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_its_derivatives_agree_with_finite_differences(
    geometry: str, kind: type[Measurement], session: Session
) -> None:
    example = Example.of(session, geometry)
    observed = observed_of(example, kind)
    assert np.isfinite(example.problem.predict(observed, example.state)[observed.valid]).all()
    assert_derivatives(example.problem, observed, example.state, example.parameters)


@each_kind
def test_fixed_coordinates_have_no_derivative(kind: type[Measurement], session: Session) -> None:
    example = Example.of(session, "dh")
    observed = observed_of(example, kind)
    entries = np.flatnonzero(example.parameters.active)[::3]
    fewer = example.parameters.fixing({int(entry): "a reason" for entry in entries})
    every, some = (
        Tangent.at(example.problem, observed, example.state, parameters).linearise().J
        for parameters in (example.parameters, fewer)
    )
    left = fewer.active[example.parameters.active]
    assert not left.all()
    np.testing.assert_allclose(some, every[..., left], rtol=1e-12, atol=1e-12 * np.abs(every).max())


@each_kind
def test_it_depends_on_the_joint_values_as_its_derivative_says(kind: type[Measurement], session: Session) -> None:
    example = Example.of(session, "none")
    observed, problem, state = observed_of(example, kind), example.problem, example.state
    J_q = Tangent.at(problem, observed, state, example.parameters).linearise().J_q
    q = observed.readings.q
    J_q = J_q.reshape(*observed.value.shape, q.shape[1])
    assert J_q.any()
    for i in range(q.shape[1]):
        step = 1e-6 * np.eye(q.shape[1])[i]
        before, after = (
            problem.residual(replace(observed, readings=replace(observed.readings, q=q + sign * step)), state)
            for sign in (-1, 1)
        )
        numeric = (after - before) / 2e-6
        assert np.abs(J_q[..., i] - numeric).max() < 1e-6 * max(np.abs(numeric).max(), 1.0)


@each_kind
def test_padding_pulls_at_nothing(kind: type[Measurement], session: Session) -> None:
    example = Example.of(session, "dh")
    observed = observed_of(example, kind)
    N, m, D = observed.value.shape

    def pad(slots: Floats, fill: float | Floats) -> Floats:
        extra = np.broadcast_to(np.asarray(fill, slots.dtype), (N, 1, *slots.shape[2:]))
        return np.concatenate([slots, extra], axis=1)

    padded = replace(
        observed,
        row=pad(observed.row, -1),
        index={key: pad(column, 0) for key, column in observed.index.items()},
        value=pad(observed.value, 0.0),
        covariance=pad(observed.covariance, np.eye(D)),
    )
    without, found = (
        Tangent.at(example.problem, slots, example.state, example.parameters).linearise()
        for slots in (observed, padded)
    )
    assert padded.count == observed.count
    assert not padded.valid[:, m].any()
    J_q, J_q_without = found.J_q.reshape(N, m + 1, D, -1), without.J_q.reshape(N, m, D, -1)
    for values in (found.residual, found.J, J_q):
        assert np.isfinite(values).all()
        assert not values[:, m].any()
        assert not values[~padded.valid].any()
    # Sums of another length round otherwise on some processors.
    np.testing.assert_allclose(found.residual[:, :m], without.residual, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.J[:, :m], without.J, rtol=1e-12, atol=1e-12 * np.abs(without.J).max())
    np.testing.assert_allclose(J_q[:, :m], J_q_without, rtol=1e-12, atol=1e-12 * np.abs(J_q_without).max())
    np.testing.assert_array_equal(padded.by_row(padded.value), observed.table.compared)


@each_kind
def test_it_does_not_matter_which_frame_the_base_link_is(kind: type[Measurement], session: Session) -> None:
    example = Example.of(session, "dh")
    observed, state = observed_of(example, kind), example.state
    links = example.problem.links(observed.readings, state)
    G = pin.exp6(np.array([0.3, -0.2, 0.5, 0.7, -0.4, 1.1]))
    moved = Links(
        links.attachments,
        tuple(G.rotation @ R for R in links.R),
        tuple(p @ G.rotation.T + G.translation for p in links.p),
    )
    elsewhere = state.replace({BASE: state[BASE] @ G.inverse().homogeneous})
    for what in ("predict", "metres_per_unit"):
        before, after = (
            getattr(observed.table, what)(observed, *at)[observed.valid] for at in ((links, state), (moved, elsewhere))
        )
        assert np.isfinite(before).all()
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-9)


@each_kind
def test_robot_and_world_moved_together_change_nothing(kind: type[Measurement], session: Session) -> None:
    # The derivatives by the frames' motions add up to zero for one common motion v + w x r of all of them.
    example = Example.of(session, "dh")
    observed = observed_of(example, kind)
    links = example.problem.links(observed.readings, example.state)
    found = observed.table.linearise(observed, links, example.state, jacobian_for(example, observed))
    np.testing.assert_allclose(
        found.predicted[observed.valid],
        observed.table.predict(observed, links, example.state)[observed.valid],
        rtol=1e-12,
        atol=1e-12,
    )
    assert len(found.by_frame) == len(links.R)
    parts = []
    for frame, by in enumerate(found.by_frame):
        if by is None:
            continue
        # Frame 0 is named by its point at the base link's origin.
        p = np.zeros_like(links.p[0]) if frame == 0 else links.p[frame]
        common = np.zeros((len(p), 6, 6))
        common[:, :3, :3] = common[:, 3:, 3:] = np.eye(3)
        common[:, :3, 3:] = np.array([-pin.skew(r) for r in p])
        parts.append(by @ common)
    assert len(parts) > 1
    largest = max(np.abs(part).max() for part in parts)
    assert largest > 0.0
    np.testing.assert_allclose(sum(parts), 0.0, atol=1e-9 * largest)


@each_kind
def test_blocks_of_poses_add_up(kind: type[Measurement], session: Session) -> None:
    example = Example.of(session, "dh")
    observed = observed_of(example, kind)
    tangent = Tangent.at(example.problem, observed, example.state, example.parameters)
    whole, half = tangent.linearise(), len(observed.pose) // 2
    parts = [tangent.linearise(poses) for poses in (slice(0, half), slice(half, len(observed.pose)))]
    for what in ("residual", "J", "J_q"):
        joined = np.concatenate([getattr(part, what) for part in parts])
        np.testing.assert_allclose(joined, getattr(whole, what), rtol=1e-12, atol=1e-9)


@each_kind
def test_no_poses_give_no_residuals(kind: type[Measurement], session: Session) -> None:
    # A fold of the cross-validation may hold none of a kind.
    example = Example.of(session, "dh")
    none = observed_of(example, kind).at(np.zeros(0, dtype=np.intp))
    assert example.problem.residual(none, example.state).shape == (0, *none.value.shape[1:])
    assert example.problem.metres_per_unit(none, example.state).shape == none.row.shape


@each_kind
@pytest.mark.parametrize("own_sigma", [False, True])
def test_a_table_written_and_read_back_is_the_same(
    own_sigma: bool, kind: type[Measurement], session: Session, tmp_path: Path
) -> None:
    table, usual, rng = session.find(kind), session.noise.spreads(kind), np.random.default_rng(0)
    sigmas = {
        name: of * (rng.uniform(0.5, 2.0, len(table)) if own_sigma else np.ones(len(table)))
        for name, of in usual.items()
    }
    table = replace(table, **sigmas)
    path = tmp_path / f"{kind.kind}.csv"
    write_measurements(path, session, table)
    header = path.read_text().splitlines()[0].split(",")
    assert header == [*kind.keys, *kind.columns, *(usual if own_sigma else [])]
    known = {
        "pose": [session.label(k) for k in range(len(session.poses))],
        "camera": session.rig.names,
        "led": session.led_names,
        "target": session.attachments.targets,
    }
    found = read_measurements(path, kind, known, usual).measurements
    assert_same_table(found, table)


@each_kind
def test_it_is_part_of_a_session_folder(kind: type[Measurement], session: Session, tmp_path: Path) -> None:
    # A noise that is not the usual one comes along, too.
    usual = {other.noise: session.noise.of(other) for other in MEASUREMENTS}
    own = {of.noise: 1.5 * of.usual for of in kind.spread_of().values()}
    session = session.with_noise({name: usual[name] for name in ("pixel", "point")} | own)
    noise, measurements = session.noise, session.measurements
    write_session(tmp_path / "session", session)
    assert (tmp_path / "session" / f"{kind.kind}.csv").is_file()
    found = read_session(tmp_path / "session")
    assert found.noise.of(kind) == noise.of(kind)
    assert {type(table) for table in found.measurements} == {type(table) for table in measurements}
    assert_same_table(found.find(kind), session.find(kind))


@each_kind
def test_rows_keep_their_order_whatever_order_they_come_in(kind: type[Measurement], session: Session) -> None:
    table = session.find(kind)
    order = np.random.default_rng(0).permutation(len(table))
    shuffled = table.rows(order)
    for name, column in table.arrays.items():
        np.testing.assert_array_equal(shuffled.arrays[name], column)
