from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.model_spec import Freedoms
from urdfcal.estimation.observations import observe
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.start import first_state
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.session.model import Led

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize(
    ("rig", "rank"), [("elbow3r", 15), ("ur5", 27), ("panda", 31), ("stanford", 25), ("so101", 23)]
)
def test_ranks_are_those_of_theory(rig: str, rank: int, simulated: Callable) -> None:
    # r + 3 with r = 4 R + 2 P: one LED of unknown place seen by two known cameras.
    identifiability = calibrate(simulated(rig).session).identifiability
    assert identifiability.rank == rank
    assert 1.0 < identifiability.condition_number < 1e4


def test_gauge_freedoms_are_named(simulated: Callable) -> None:
    lost = calibrate(simulated("ur5").session).identifiability.lost
    stands = "cannot be told from where the robot stands (T_world_base): it is held as drawn"
    assert lost == (
        f"d of row 1 (shoulder_pan_joint) {stands}",
        f"theta of row 1 (shoulder_pan_joint) {stands}",
        "theta of row 6 (wrist_3_joint) cannot be told from where the LEDs sit: it is held as drawn",
    )


def test_an_led_on_the_last_axis_tells_less(simulated: Callable) -> None:
    data = simulated("ur5")
    on_axis = Led("led", np.array([0.0, 0.0, 0.05]), 0.005)
    session = replace(data.session, leds=(on_axis,))
    table = DHTable.from_chain(data.session.chain)
    state = replace(first_state(session, table, np.zeros_like(table.nominal)), leds=np.array([[0.0, 0.0, 0.05]]))
    parameters = choose_parameters(session, table, state, Freedoms("dh", ("fixed",) * 2, ("fixed",) * 2))
    assert identify(table, observe(session), state, parameters).rank == 25


def test_two_runs_hold_the_same_parameters(simulated: Callable) -> None:
    a, b = (calibrate(simulated("stanford", seed=seed).session).identifiability for seed in (0, 1))
    assert a.lost == b.lost
    assert list(a.parameters.reasons) == list(b.parameters.reasons)
