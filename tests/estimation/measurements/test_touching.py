"""Contacts, planes and distances: the truth recovered without a camera, and what they alone cannot tell."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from tests.touching import KINDS, PLACES_AT, PLANES_AT, arm, touched
from tests.worlds import ALONE
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.known_distances import KnownDistances
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.places import PLACES
from urdfcal.estimation.blocks.planes import PLANES
from urdfcal.estimation.diagnosis.residuals import Unexplained
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.measurements import Contacts, Distances, Planes
from urdfcal.estimation.noise import find_noise
from urdfcal.estimation.scale import find_scale
from urdfcal.estimation.start import first_state
from urdfcal.estimation.state import State
from urdfcal.estimation.validation import hold_out
from urdfcal.pipeline import calibrate
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.knowledge import Estimate, Led
from urdfcal.simulation.simulate import draw_offsets

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.estimation.scale import LengthScale
    from urdfcal.session.model import Session

pytestmark = pytest.mark.usefixtures("no_trials")
each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.kind)
LED = np.array([[0.012, 0.004, 0.123]])


def offsets(seed: int = 3) -> Floats:
    return draw_offsets(rows_of(arm().chain), np.random.default_rng(seed))


def scale_of(session: Session) -> LengthScale:
    found = Estimated.of(session)
    left = Unexplained.of(session, found.problem, found.fit, find_noise(found.problem, found.fit))
    return find_scale(found.problem, found.fit, left)


def tip_error(calibration: Estimated, true: Floats) -> tuple[float, float]:
    """Rms distances of the nominal and of the calibrated tip from the true one. [m]."""
    chain = arm().chain
    q = chain.random_values(300, np.random.default_rng(0))
    truth = chain.with_placements(rows_of(chain).placements(true))
    arms = (chain, chain.with_placements(calibration.placements))
    before, after = (float(np.sqrt(np.mean(compare(truth, one, q).position ** 2))) for one in arms)
    return before, after


@each_kind
def test_the_arm_comes_out_without_a_camera(kind: type[Measurement]) -> None:
    true = offsets()
    data = touched(kind, 160, sigma=1e-7, joint=0.0, offsets=true, led=LED)
    calibration = Estimated.of(data.session, priors=False)
    before, after = tip_error(calibration, true)
    assert before > 1e-3
    # Without priors nothing but scale could be lost, and planes have none.
    if kind is not Planes:
        assert after < 1e-5
    np.testing.assert_allclose(calibration.fit.reduced_chi2, 1.0, atol=0.35)


@each_kind
def test_what_turns_with_everything_is_fixed_and_said_and_no_warning(kind: type[Measurement]) -> None:
    data = touched(kind, 120, offsets=offsets(), led=LED)
    calibration = calibrate(replace(data.session, estimate=Estimate("dh")), force=True)
    lost = calibration.identifiability.unidentifiable
    what = "planes" if kind is Planes else "places"
    for parameter in ("d", "theta"):
        assert any(f"{parameter} of row 1" in text and f"where the {what} are" in text for text in lost)
    # An arm drawn from its tolerances, noise as declared: there is nothing to warn of but that four places are few,
    # and that planes say nothing of how large everything is.
    reasons = calibration.assessment.reasons
    unscaled = [text for text in reasons if text.startswith("all lengths together are known to")]
    assert len(unscaled) == (kind is Planes)
    assert all("hold elsewhere" in text for text in set(reasons) - set(unscaled))
    np.testing.assert_array_equal(calibration.estimate.T_world_base, np.eye(4))


def test_an_arm_that_is_far_off_loses_what_it_cannot_tell_all_the_same() -> None:
    # A residual of centimetres turns with the base, and its derivative is not zero.
    true = 4.0 * offsets()
    found = Estimated.of(touched(Contacts, 120, offsets=true, led=LED).session)
    assert sum("where the places are" in text for text in found.identifiability.unidentifiable) == 2


@each_kind
def test_an_led_of_unknown_place_is_found(kind: type[Measurement]) -> None:
    data = touched(kind, 160, sigma=1e-6, joint=0.0, led=LED)
    session = replace(data.session, leds=(Led("ball"),))
    table = rows_of(session.chain)
    start = first_state(session, table, no_offsets(table))
    if kind is Contacts:  # in closed form
        np.testing.assert_allclose(start[LEDS], LED, atol=1e-5)
    # Along axes that nothing turns about it is the places' or the planes' own.
    np.testing.assert_allclose(Estimated.of(session, "none").fit.state[LEDS], LED, atol=2e-5)


def test_things_start_where_the_nominal_arm_touches_them() -> None:
    for kind, key, expected in ((Contacts, PLACES, PLACES_AT), (Distances, PLACES, PLACES_AT), (Planes, PLANES, None)):
        session = touched(kind, 60, sigma=1e-6, joint=0.0).session
        table = rows_of(session.chain)
        found = first_state(session, table, no_offsets(table))[key]
        if expected is None:
            expected = PLANES_AT * np.sign(
                np.take_along_axis(PLANES_AT, np.abs(PLANES_AT[:, :3]).argmax(1)[:, None], 1)
            )
        np.testing.assert_allclose(found, expected, atol=1e-4)


class TestScale:
    def test_known_distances_are_the_unit(self) -> None:
        scale = scale_of(touched(Contacts, 120, offsets=offsets(), led=LED).session)
        assert scale.unit == "distances"
        assert 1e-4 < scale.tip_per_permille < 1e-2
        assert np.isfinite(scale.sigma)

    def test_a_wrong_one_is_named_as_that(self) -> None:
        session = touched(Contacts, 160, offsets=offsets(), led=LED).session
        (known,) = session.place_distances
        right, longer = scale_of(session), replace(known, distance=1.02 * known.distance)
        wrong = replace(session, place_distances=(longer,), **ALONE)
        wrong = calibrate(wrong, force=True)
        assert wrong.evidence.scale.factor - right.factor == pytest.approx(0.02, rel=0.2)
        assert any("check the distances that are given as known" in text for text in wrong.assessment.reasons)

    @pytest.mark.parametrize("kind", [Contacts, Planes])
    def test_without_any_the_tolerances_are(self, kind: type[Measurement]) -> None:
        session = touched(kind, 120, offsets=offsets(), led=LED, distances=False).session
        scale = scale_of(session)
        assert scale.unit == "nothing"
        assert scale.tip_per_permille == 0.0
        assert any("the scale" in text for text in Estimated.of(session).identifiability.unidentifiable)

    def test_a_ball_bar_has_its_own(self) -> None:
        session = touched(Distances, 120, offsets=offsets(), led=LED, distances=False).session
        assert scale_of(session).unit == "instrument"
        assert scale_of(replace(session, scale_sigma=1e-3)).declared == 1e-3


class TestTogether:
    def test_a_place_that_two_tables_name_is_one(self) -> None:
        """The ball bar's centre is the socket that is touched, whatever the tables number it."""
        contacts, bar = (touched(kind, 80, sigma=1e-5, joint=0.0, led=LED).session for kind in (Contacts, Distances))
        count = len(contacts.poses)
        (table,) = bar.measurements
        names = {"place": ("place3", "place1", "other", "place0")}
        order = np.array([3, 1, 2, 0])
        table = replace(table, pose=table.pose + count, place=order[table.place], names=names)
        session = replace(
            contacts,
            poses=tuple(f"{k}" for k in range(count + len(bar.poses))),
            q=np.vstack([contacts.q, bar.q]),
            previous=None,
            part=np.zeros(0, int),
            measurements=(*contacts.measurements, table),
            noise=replace(contacts.noise, other={"contact": 1e-5, "distance": 1e-5}),
        )
        assert session.named("place") == ("place0", "place1", "place2", "place3", "other")
        found = Estimated.of(session, "none").fit.state[PLACES]
        np.testing.assert_allclose(found, PLACES_AT[[0, 1, 2, 3, 2]], atol=2e-5)

    def test_a_distance_of_a_place_that_is_not_measured_says_nothing(self) -> None:
        session = touched(Contacts, 80, led=LED).session
        some = session.at(np.flatnonzero(session.measurements[0].place != 1))
        found = Estimated.of(some).fit
        assert found.parameters.distances == ()
        assert not found.parameters.active[found.parameters.columns(PLACES)][3:6].any()

    def test_distances_are_those_of_their_block(self) -> None:
        known = KnownDistances.of(PLACES, ("a", "b", "c"), touched(Contacts).session.place_distances[:0])
        assert len(known) == 0
        known = KnownDistances(PLACES, ((0, 2, 3.0, 0.5),), 3)
        state = State({PLACES: np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0], [0.0, 4.0, 0.0]])})
        r, J = known.residuals(state)
        assert r.tolist() == [2.0]
        assert J.reshape(3, 3)[:, 1].tolist() == [-2.0, 0.0, 2.0]
        assert known.by_scale.tolist() == [6.0]


class TestHeldOut:
    def test_a_place_left_out_is_fitted_to_its_own_poses(self) -> None:
        """The arm's error is what counts: where the place is nothing else could tell."""
        session = touched(Contacts, 120, sigma=1e-4, joint=0.0, led=LED).session
        calibration = Estimated.of(session, "none")
        by_place = np.zeros(len(session.poses), dtype=np.intp)
        by_place[session.measurements[0].pose] = session.measurements[0].place
        held_out = hold_out(calibration.problem, calibration.fit, by_place)
        # As much longer as the fit of three coordinates to each place has made them.
        rms = np.sqrt(np.mean(held_out.distance[0] ** 2))
        assert rms == pytest.approx(np.sqrt(3.0) * 1e-4, rel=0.1)

    def test_the_full_estimate_does_not_leak_into_it(self) -> None:
        session = touched(Contacts, 80, sigma=1e-4, joint=0.0, led=LED).session
        calibration = Estimated.of(session, "none")
        by_place = np.zeros(len(session.poses), dtype=np.intp)
        by_place[session.measurements[0].pose] = session.measurements[0].place
        fit = calibration.fit
        elsewhere = replace(fit, state=fit.state.replace({PLACES: fit.state[PLACES] + 0.05}))
        found = [hold_out(calibration.problem, of, by_place).distance[0] for of in (fit, elsewhere)]
        np.testing.assert_allclose(found[1], found[0], atol=2e-6)
