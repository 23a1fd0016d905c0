from __future__ import annotations

import numpy as np

from urdfcal.output.figures import _arrows


def test_an_arrow_that_leaves_the_area_keeps_its_direction_and_has_no_head() -> None:
    start = np.array([[50.0, 20.0], [50.0, 20.0], [10.0, 10.0]])
    arrow = np.array([[30.0, -60.0], [5.0, 5.0], [0.0, 0.0]])
    cut, whole, none = _arrows(start, arrow, ((0.0, 100.0), (0.0, 80.0)))
    np.testing.assert_allclose(cut[1], [60.0, 0.0])  # pixels count downwards, the chart's y upwards
    np.testing.assert_allclose(cut[2:], np.broadcast_to(cut[1], (3, 2)))
    direction = (cut[1] - cut[0]) * [1.0, -1.0]
    np.testing.assert_allclose(np.cross([*direction, 0.0], [*arrow[0], 0.0]), 0.0, atol=1e-9)
    np.testing.assert_allclose(whole, _arrows(start[1:2], arrow[1:2])[0])
    assert not np.allclose(whole[2], whole[1])
    np.testing.assert_allclose(none, np.broadcast_to([10.0, -10.0], (5, 2)))
