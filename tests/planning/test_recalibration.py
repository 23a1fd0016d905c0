from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.measuring import measured_at, true_error
from urdfcal.errors import SessionError
from urdfcal.pipeline import calibrate
from urdfcal.planning.planner import Planner
from urdfcal.planning.recalibration import scene_of, tolerances_of
from urdfcal.result.calibration import Calibration
from urdfcal.result.document import ResultDocument
from urdfcal.session.knowledge import Estimate, Tolerances

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.simulation.truth import Simulated


@pytest.fixture(scope="module")
def before(simulated: Callable[..., Simulated]) -> tuple[Simulated, Calibration]:
    """A simulated arm, and its calibration as read from a file."""
    made = simulated("ur5", poses=16)
    session = replace(made.session, estimate=Estimate("dh", "fixed", "fixed"))
    return made, Calibration(ResultDocument.model_validate(calibrate(session, force=True).to_dict()))


@pytest.mark.no_cover
def test_six_poses_recalibrate_an_arm_that_is_known(before: tuple[Simulated, Calibration]) -> None:
    made, calibration = before
    plan = Planner(calibration, candidates=300).plan(6)
    assert "not checked for collisions" in plan.warnings[0]  # there is no URDF beside it
    setup, scene = scene_of(calibration, made.session.urdf)
    pixels, seen = (of.pixels(made.session.q) for of in (made.truth, scene))
    assert np.abs(pixels - seen).max() < 1.0
    q = plan.q[plan.rank >= 0]
    assert made.truth.in_image(made.truth.pixels(q)).all()
    measured = replace(measured_at(made, q, seed=1), estimate=Estimate("dh", "fixed", "fixed"))
    known = replace(measured, chain=calibration.chain.with_placements(calibration.placements), urdf=None)
    found = true_error(made, calibrate(replace(known, tolerances=setup.tolerances), force=True))
    assert found < 1.5 * plan.likely[-1]
    assert found < 0.5 * true_error(made, calibrate(measured, force=True))


def test_zero_offsets_say_nothing_of_the_links(before: tuple[Simulated, Calibration]) -> None:
    document = before[1].document
    zeros = [row for row in document.dh if row.parameter == "theta"]
    assert any(row.sigma for row in zeros)
    assert tolerances_of(document.model_copy(update={"dh": zeros})) == Tolerances()


def test_what_came_out_is_known_and_the_zeros_are_not(before: tuple[Simulated, Calibration]) -> None:
    known = tolerances_of(before[1].document)
    assert known.length < 1e-3
    assert known.angle < 2e-3
    assert known.zero == 5e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d | {"cameras": {}}, "without cameras"),
        (lambda d: d | {"sessions": dict.fromkeys("ab", d["sessions_entry"])}, "several sessions"),
        (
            lambda d: d | {"cameras": {k: {**c, "resolution": None} for k, c in d["cameras"].items()}},
            "how large the images",
        ),
        (
            lambda d: d | {"targets": {"board": {"link": "tool0", "T_link_target": np.eye(4).tolist(), "sigma": []}}},
            "targets",
        ),
    ],
)
def test_a_result_that_does_not_say_what_measures_is_refused(
    before: tuple[Simulated, Calibration], change: Callable, message: str
) -> None:
    data = before[1].to_dict()
    entry = {"T_world_base": data["T_world_base"], "T_world_base_sigma": [], "poses": 8, "leds": [], "cameras": []}
    changed = change(data | {"sessions_entry": entry | {"residuals": []}})
    changed.pop("sessions_entry")
    with pytest.raises(SessionError, match=message):
        Planner(Calibration(ResultDocument.model_validate(changed)))
