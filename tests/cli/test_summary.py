from __future__ import annotations

from urdfcal.cli.summary import _outliers


def test_the_farthest_outlier_is_named() -> None:
    ball = {"pose": "05", "camera": None, "led": "ball", "residual": 363.2, "sigmas": 1790.0}
    light = {"pose": "12", "camera": "cam0", "led": "led", "residual": 41.23, "sigmas": 40.0}
    assert _outliers([]) == "0 outliers"
    assert _outliers([ball]) == "1 outlier, pose 05 ball by 363 mm"
    assert _outliers([light]) == "1 outlier, pose 12 cam0 led by 41.2 px"
    assert _outliers([light, ball]) == "2 outliers, the farthest pose 05 ball by 363 mm"
