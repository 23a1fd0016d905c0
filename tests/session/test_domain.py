from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.session.domain import beyond, outside

if TYPE_CHECKING:
    from collections.abc import Callable


def test_joints_outside_what_was_calibrated_are_named(simulated: Callable) -> None:
    session = simulated("elbow3r").session
    q = np.array(session.chain.readings(session.q))
    q[:] = 0.5
    q[3:5, 1] = [1.3, -0.21]
    q[6, 2] = 0.5 + 2.0 * np.pi  # the same place
    q[7, 0] = 1.04  # repeats what was measured
    domain = {"joint_1": [0.0, 1.0], "joint_2": [0.0, 1.0], "joint_3": [0.0, 1.0]}
    (one,) = outside(session.chain, q, domain)
    assert (one.joint, one.poses, one.unit) == ("joint_2", 2, "rad")
    assert one.beyond == pytest.approx(0.3)
    assert str(one) == "joint_2 was calibrated from 0.00 to 1.00 rad: 2 poses are outside, by up to 0.3 rad"
    assert outside(session.chain, q, {}) == ()


def test_a_sliding_joint_does_not_turn(simulated: Callable) -> None:
    session = simulated("stanford").session
    (slides,) = [joint.name for joint in session.chain.joints if joint.prismatic]
    q = session.chain.readings(session.q)
    values = q[:, session.chain.actuated.index(slides)]
    low, high, turn = float(values.min()), float(values.max()), 2.0 * np.pi
    (one,) = outside(session.chain, q, {slides: [low - turn, high - turn]})
    assert (one.unit, one.poses) == ("m", len(q))
    assert not beyond(session.chain, q, {slides: [low, high]}).any()
