from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.measuring import both, measured_at, true_error
from tests.states import true_state_of
from urdfcal.errors import SessionError
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.planning import planner as module
from urdfcal.planning.belief import Belief
from urdfcal.planning.planner import Planner, base_margin
from urdfcal.planning.prospect import Prospect
from urdfcal.planning.route import Route
from urdfcal.robot.dh import DHTable
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.mechanism import BASE
from urdfcal.session.knowledge import Estimate, LedDistance
from urdfcal.session.obstacle import Obstacle
from urdfcal.simulation.planning import MARGIN, CollisionChecker, in_view, load_collision_checker
from urdfcal.simulation.simulate import nominal_scene
from urdfcal.study.monte_carlo import Variation, varied_rig

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.planning.planner import Plan
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.rig_description import RigDescription
    from urdfcal.simulation.truth import Simulated

DECIDE = "tolerances decide"


@pytest.fixture(scope="module")
def few(simulated: Callable[..., Simulated]) -> Simulated:
    made = simulated("ur5", poses=16)
    session = replace(made.session, estimate=Estimate("dh", "fixed", "fixed"))
    return replace(made, session=session.at(np.arange(8)))


@pytest.fixture(scope="module")
def calibration(few: Simulated) -> FittedCalibration:
    return calibrate(few.session, force=True)


@pytest.fixture(scope="module")
def planner(few: Simulated) -> Planner:
    return Planner(few.session, candidates=400)


@pytest.fixture(scope="module")
def plan(planner: Planner) -> Plan:
    return planner.plan(8)


@pytest.mark.no_cover
def test_planned_poses_bring_more_than_as_many_random_ones_and_what_is_expected_of_them(
    simulated: Callable[..., Simulated], few: Simulated, plan: Plan, calibration: FittedCalibration
) -> None:
    belief = Belief.of_calibration(calibration).identified_by(plan.q)
    at = belief.candidates(plan.q[plan.rank >= 0], few.session.chain.random_values(300, np.random.default_rng(0)))
    random = at.error(belief.with_session(simulated("ur5", poses=16).session).information)
    planned = at.error(belief.information + at.information(range(8)))
    assert planned == pytest.approx(plan.errors[-1])
    assert planned < 0.6 * random
    more = measured_at(few, plan.q[plan.rank >= 0], seed=0)
    assert true_error(few, calibrate(both(few.session, more), force=True)) < 1.5 * plan.likely[-1]


def test_every_pose_and_move_is_free_and_seen_on_the_true_arm(few: Simulated, plan: Plan) -> None:
    checker, _ = load_collision_checker(few.truth, few.session)
    assert checker is not None
    here = few.session.q[-1]
    for q in plan.q:
        assert all(checker.is_free(here + step * (q - here)) for step in np.linspace(0.0, 1.0, 50)[1:])
        here = q
    measured = plan.q[plan.rank >= 0]
    centres = few.truth.camera_centres(measured)
    assert few.truth.in_image(few.truth.pixels(measured)).all()
    assert all(checker.is_seen(q, c) for q, c in zip(measured, centres, strict=True))


def test_random_poses_are_kept_to_check_by(few: Simulated, planner: Planner, plan: Plan) -> None:
    checked = planner.plan(8, check=True)
    assert not plan.check.any()
    assert checked.check.sum() == 4
    assert sorted(checked.rank[checked.rank >= 0]) == list(range(8))
    assert not np.any(checked.check & (checked.rank >= 0))
    np.testing.assert_array_equal(checked.measured, checked.check | (checked.rank >= 0))
    np.testing.assert_array_equal(checked.errors, plan.errors)
    checks, scene = checked.q[checked.check], few.truth
    assert scene.in_image(scene.pixels(checks)).all()


def test_the_next_pose_is_new_and_brings_most(few: Simulated, planner: Planner, calibration: FittedCalibration) -> None:
    q = planner.next(few.session)
    one = planner.plan(1)
    workspace, random = (few.session.chain.random_values(300, np.random.default_rng(seed)) for seed in (0, 1))
    belief = Belief.of_calibration(calibration).identified_by(random)
    measured = one.q[one.rank == 0]
    assert belief.told_by(measured).shape[0] == 1
    gains = belief.candidates(np.vstack([measured, q[None], few.session.q]), workspace).gains(belief.information)
    assert gains[0] >= gains[1] > gains[2:].max()
    longer = both(few.session, measured_at(few, np.tile(q, (3, 1)), seed=0))
    # Readings are noisy: the same pose is not the same number, and is still no new one.
    assert np.abs(planner.next(longer) - q).max() > 1e-2


def test_a_misfit_makes_what_is_measured_worth_less(few: Simulated, calibration: FittedCalibration) -> None:
    belief = Belief.of_calibration(calibration)
    worse = replace(belief, misfit=3.0).with_session(few.session)
    same = replace(belief, misfit=1.0).with_session(few.session)
    assert np.trace(worse.information) < np.trace(same.information)


def test_before_anything_is_measured_the_margin_is_wider() -> None:
    rig = read_rig(find_rig("ur5"))
    assert base_margin(rig) > 1.5 * MARGIN
    plan = Planner(rig, candidates=300).plan(3)
    measured, scene = plan.q[plan.rank >= 0], nominal_scene(rig)
    assert scene.in_image(scene.pixels(measured), base_margin(rig)).all()
    moved = np.array(scene.T_world_base)
    moved[:3, 3] += 0.03 / np.sqrt(3.0)
    moved_scene = replace(scene, T_world_base=moved)
    assert moved_scene.in_image(moved_scene.pixels(measured)).all()


def test_the_arm_keeps_clear_of_cameras_and_itself() -> None:
    rig = read_rig(find_rig("ur5"))
    assert rig.urdf is not None
    q = rig.chain.random_values(300, np.random.default_rng(0))
    checkers = [CollisionChecker(rig.chain, rig.urdf, [], [(BASE, np.array([0.5, 0.2, 0.4]))], of) for of in (0.0, 0.1)]
    bare, clear = (np.array([checker.is_free(q_k) for q_k in q]) for checker in checkers)
    assert not np.any(clear & ~bare)
    assert clear.sum() < bare.sum()
    alone = CollisionChecker(rig.chain, rig.urdf, [], [], 0.1)
    assert np.sum([alone.is_free(q_k) for q_k in q]) > clear.sum()


def test_the_arm_keeps_clear_of_the_table_though_many_poses_reach_below_it() -> None:
    rig = read_rig(find_rig("so101"))
    assert rig.urdf is not None
    checker = CollisionChecker(rig.chain, rig.urdf, *nominal_scene(rig).points_on_joints(), 0.05)
    q = rig.chain.random_values(300, np.random.default_rng(0))
    height = tip_poses(rig.chain, q)[:, 2, 3]
    low = q[(height > -0.03) & (height < 0.02)]
    assert len(low) > 5
    assert not any(checker.is_free(q_k) for q_k in low)


@pytest.mark.no_cover
def test_what_stands_around_is_kept_clear_of_and_hides_leds(few: Simulated) -> None:
    assert few.session.urdf is not None
    chain, nominal, urdf = few.session.chain, nominal_scene(read_rig(find_rig("ur5"))), few.session.urdf
    plain = Planner(few.session, candidates=100).plan(4)
    measured = plain.q[plain.rank >= 0]
    tips = tip_poses(chain, measured)[:, :3, 3]
    furthest = int(np.argmax(np.linalg.norm(tips, axis=1)))
    crate = Obstacle("crate", np.full(3, 0.2), tips[furthest])
    plan = Planner(few.session, candidates=100, scene=(crate,)).plan(4)
    around = CollisionChecker(chain, urdf, *nominal.outlined().points_on_joints(), 0.0, [crate])
    assert not around.is_free(measured[furthest])
    here = plan.q[0]
    for q in plan.q:
        assert all(around.is_free(here + step * (q - here)) for step in np.linspace(0.0, 1.0, 60))
        here = q
    centres = nominal.camera_centres(measured[:1])[0]
    led = nominal.led_positions(measured[:1])[0, 0]
    screen = Obstacle("screen", np.full(3, 0.02), 0.5 * (centres[0] + led))
    for scene, seen in ((), True), ((screen,), False):
        checker = CollisionChecker(chain, urdf, *nominal.outlined().points_on_joints(), 0.0, scene)
        assert checker.is_seen(measured[0], centres) == seen
    beside = Obstacle("beside", np.full(3, 0.002), np.add(screen.position, [0.0, 0.0, 0.004]))
    for clearance, seen in (0.0, True), (0.02, False):
        checker = CollisionChecker(chain, urdf, *nominal.outlined().points_on_joints(), clearance, [beside])
        assert checker.is_seen(measured[0], centres) == seen


def test_a_box_in_the_arms_way_wherever_it_goes_is_refused(few: Simulated) -> None:
    with pytest.raises(SessionError, match="collides with box floor in every pose"):
        Planner(few.session, scene=(Obstacle("floor", (2, 2, 0.4), (0, 0, 0)),)).plan(3)


def test_what_no_poses_tell_is_said_and_what_would() -> None:
    rig, _ = varied_rig(read_rig(find_rig("ur5")), Variation("cameras", 1))  # which tells no lengths

    def prospect(rig: RigDescription) -> Prospect:
        q, _, _ = in_view(nominal_scene(rig), 40, np.random.default_rng(0), MARGIN)
        workspace = rig.chain.random_values(50, np.random.default_rng(1))
        return Prospect.of(Belief.of_rig(rig, q), workspace, 120, margin=MARGIN, seed=0)

    one = prospect(rig)
    floor = one.floor(one.belief)
    assert floor > 3e-4
    assert one.limits(2.0 * floor) == ()
    assert one.limits(1.1 * floor) == (
        f"{1e3 * floor:.2g} mm of the tip's expected error no poses take away: {DECIDE}",
    )
    (led,) = rig.leds
    rig = replace(rig, leds=(led, replace(led, name="other", position=np.add(led.position, [0.0, 0.1, 0.0]))))
    two = prospect(rig)
    (said,) = two.limits(two.floor(two.belief))
    known = prospect(replace(rig, led_distances=(LedDistance((led.name, "other"), 0.1, 1e-4),)))
    left = f"would leave {1e3 * known.floor(known.belief):.2g}"
    assert said.endswith(f"{DECIDE}; the distance of led and other, by calliper and named in led_distances, {left}")


def test_an_arm_of_one_length_before_one_camera_is_known_no_better_than_that_length() -> None:
    rig, _ = varied_rig(read_rig(find_rig("elbow3r")), Variation("cameras", 1))
    q, _, _ = in_view(nominal_scene(rig), 40, np.random.default_rng(0), MARGIN)
    belief = Belief.of_rig(rig, q).identified_by(q)
    told = belief.candidates(q, rig.chain.random_values(50, np.random.default_rng(1)))
    assert told.error(belief.information + 1e4 * told.information(range(len(q)))) > 3e-4, "its tolerance is 1 mm"


def test_only_a_distance_that_can_be_measured_and_is_not_known_is_asked_for(few: Simulated) -> None:
    rig = read_rig(find_rig("ur5"))
    (led,) = rig.leds

    def asked(*names: str, known: tuple[LedDistance, ...] = ()) -> tuple[str, str] | None:
        places = [np.add(led.position, [0.0, 0.02 * k, 0.0]) for k in range(len(names))]
        leds = tuple(replace(led, name=name, position=at) for name, at in zip(names, places, strict=True))
        belief = Belief.of_rig(replace(rig, leds=leds, led_distances=known), few.session.q)
        found = belief.with_distance(1e-4)
        return None if found is None else found[0]

    assert asked("a", "b", "c") == ("a", "c")
    assert asked("a", "b", "c", known=(LedDistance(("c", "a"), 0.04, 1e-4),)) in (("a", "b"), ("b", "c"))
    assert asked("a", "b", "a@31") is None, "a is not where it was, and b alone"
    assert asked("a", "a@31", "a@40") is None
    assert asked("b", "c", "a", "a@31") == ("b", "c")


def test_what_cannot_be_planned_is_refused(few: Simulated) -> None:
    with pytest.raises(SessionError, match="no camera is there"):
        Planner(read_rig(find_rig("panda_sockets")))
    with pytest.raises(SessionError, match="nothing says where the arm stands"):
        Planner(few.session.unmeasured())
    with pytest.raises(SessionError, match="candidates are none"):
        Planner(few.session, candidates=0)
    with pytest.raises(SessionError, match="poses are free, of 12"):
        Planner(few.session, candidates=12).plan(15)
    with pytest.raises(
        SessionError, match=r"of 50 poses found.*for none to check by \(--no-check\), for fewer poses, or among more"
    ):
        Planner(few.session, candidates=100).plan(50, check=True)


@pytest.mark.no_cover
def test_fewer_poses_than_asked_for_are_planned_where_there_are_no_more(few: Simulated) -> None:
    at = Planner(few.session, candidates=100)
    plan = at.plan(30, check=True)
    assert 15 <= plan.count < 30
    # Every planned pose is reached and counted, and none but those.
    assert sorted(plan.rank[plan.rank >= 0].tolist()) == list(range(plan.count))
    assert len(plan.errors) == len(plan.likely) == plan.count + 1
    assert plan.check.any()
    (said,) = [warning for warning in plan.warnings if "poses found" in warning]
    assert said.startswith(f"{plan.count} of 30 poses found, among 100 in view")
    assert "--no-check" in said
    assert not [warning for warning in at.plan(5).warnings if "poses found" in warning]


def test_what_no_way_leads_to_is_left_out_and_counted(few: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of twelve poses and four to check by the third, the eleventh and the first of those to check are never reached.
    def without_some(q: np.ndarray, *_: object) -> Route:
        reached = [k for k in range(len(q)) if k not in (2, 10, 12)]
        return Route(q[reached], np.array(reached), (2, 10, 12)) if len(q) > 12 else Route(q, np.arange(len(q)), ())

    monkeypatch.setattr(module, "route", without_some)
    monkeypatch.setattr(module, "_TRIES", 1)
    plan = Planner(few.session, candidates=400).plan(12, check=True)
    assert plan.rank.tolist() == [*range(10), -1, -1, -1]
    assert plan.check.tolist() == [False] * 10 + [True] * 3
    assert len(plan.errors) == 11
    said = [of for of in plan.warnings if "way leads to" in of]
    assert said[0] == "no free way leads to 1 of the poses to check by"
    assert said[1].startswith("10 of 12 poses found")


def test_what_is_found_until_an_error_is_planned_however_few_of_the_most(few: Simulated) -> None:
    plan = Planner(few.session, candidates=100).plan(100, until=1e-6)
    assert 0 < plan.count < 50
    (said,) = [of for of in plan.warnings if "poses found" in of]
    assert "--no-check" not in said  # there are none
    assert plan.likely[-1] > 1e-6


@pytest.mark.no_cover
def test_no_fewer_poses_would_do() -> None:
    # Chosen one by one, each for what it brings, twelve are needed: where nothing is known the first ones are wasted.
    planner = Planner(read_rig(find_rig("ur5")), candidates=400)
    plan = planner.plan(60, until=5e-4)
    assert plan.likely[-1] <= 5e-4
    assert planner.plan(plan.count - 1).likely[-1] > 5e-4


def test_a_tag_beside_the_gripper_that_carries_it_is_planned_for() -> None:
    # Its corners are within millimetres of what the gripper is drawn as: it does not hide them.
    plan = Planner(read_rig(find_rig("so101_apriltag")), candidates=400).plan(3)
    assert plan.count == 3


def test_the_belief_has_all_parameters_of_the_rigid_arm(few: Simulated) -> None:
    offsets = replace(few.session, estimate=Estimate("offsets", "fixed", "fixed"))
    belief = Belief.of_calibration(calibrate(offsets, force=True))
    table = DHTable.from_chain(few.session.chain)
    problem = Problem.of(few.session, table)
    spec = ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2)
    whole = choose_parameters(few.session, problem, true_state_of(few), spec)
    assert set(whole.names) <= set(belief.parameters.names)
