from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from urdfcal.estimation.time_offset import start_state
from urdfcal.estimation.words import sentence

from urdfcal.estimation.model_spec import Freedoms
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.robot.dh import DHTable
from urdfcal.simulation.motion import Motion, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable


def test_a_lens_or_a_clock_is_not_said_to_be_a_cameras_place(simulated: Callable) -> None:
    session = set_in_motion(simulated("ur5", poses=8), Motion()).session
    table = DHTable.from_chain(session.chain)
    state = replace(start_state(session, table, np.zeros_like(table.nominal)), time_offsets=np.zeros(2))
    parameters = choose_parameters(session, table, state, Freedoms("dh", ("free",) * 2, ("fixed", "free")))
    victim = parameters.names.index("elbow_joint.theta")
    place, lens, clock = (parameters.names.index(f"cam1.{what}") for what in ("rz", "cx", "time_offset"))
    said = [sentence(table, parameters, victim, [k], held=True) for k in (place, lens, clock)]
    theta = "theta of row 3 (elbow_joint) cannot be told from"
    assert said == [
        f"{theta} where cam1 is fastened: it is held as drawn",
        f"{theta} cam1.cx: it is held as drawn",
        f"{theta} cam1.time_offset: it is held as drawn",
    ]
