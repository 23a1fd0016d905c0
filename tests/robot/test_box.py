from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.box import in_box, parse_box
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from collections.abc import Callable


def test_a_box_holds_the_tips_between_its_corners(simulated: Callable) -> None:
    chain = simulated("ur5").session.chain
    q = chain.random_values(500, np.random.default_rng(0))
    box = parse_box("-0.2:0.6,-1e3:0,0.1:0.5")
    np.testing.assert_array_equal(box, [[-0.2, 0.6], [-1000.0, 0.0], [0.1, 0.5]])
    inside = in_box(chain, q, box)
    for p, held in zip(tip_poses(chain, q)[:, :3, 3], inside, strict=True):
        assert held == (-0.2 <= p[0] <= 0.6 and p[1] <= 0.0 and 0.1 <= p[2] <= 0.5)
    assert 10 < inside.sum() < 490


@pytest.mark.parametrize(
    "text", ["nonsense", "0:1,0:1", "0:1,0:1,1:0", "0:1,0:1,0:nan", "0:inf,0:1,0:1", "0,1,0,1,0,1"]
)
def test_what_is_no_box_is_told_how_one_is_written(text: str) -> None:
    with pytest.raises(RobotError, match="x0:x1,y0:y1,z0:z1, in metres in the base link's frame"):
        parse_box(text)
