from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.arrays import inverse
from urdfcal.cli import run
from urdfcal.errors import SessionError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.study.monte_carlo import Run, Variation, run_one, settings_of, varied_rig

if TYPE_CHECKING:
    from urdfcal.study.monte_carlo import Varied

UR5 = find_rig("ur5")


def test_a_run_is_the_same_in_whatever_order_and_expects_what_comes() -> None:
    runs = [Run(find_rig("elbow3r"), Variation("poses", 20), seed) for seed in range(4)]
    there = np.array([run_one(run) for run in runs])
    np.testing.assert_array_equal(run_one(runs[1]), there[1])
    nominal, error, expected = np.sqrt(np.mean(there**2, axis=0))
    assert error < 0.2 * nominal
    assert 0.5 * expected < error < 2.0 * expected


def test_a_baseline_is_longer_and_looks_at_the_same_place() -> None:
    rig, (wide, _) = read_rig(UR5), varied_rig(read_rig(UR5), Variation("baseline", 1.5))
    before, after = (np.linalg.norm(inverse(np.array(of.rig.T_cam_world[1]))[:3, 3]) for of in (rig, wide))
    assert after == pytest.approx(1.5 * before)
    aim = wide.rig.T_cam_world[1] @ [0.0, 0.0, np.linalg.norm(rig.stand.look_at - rig.stand.position), 1.0]
    assert aim[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert aim[2] > 0.0


@pytest.mark.parametrize(
    ("varied", "value", "got"),
    [
        ("lens", 0.5, lambda rig, _: rig.rig.cameras[1].intrinsics[0] / read_rig(UR5).rig.cameras[1].intrinsics[0]),
        ("cameras", 1, lambda rig, _: len(rig.rig.cameras)),
        ("leds", 3, lambda rig, _: len(rig.leds)),
        ("poses", 12, lambda _, options: options["poses"]),
        ("pixel", 0.3, lambda _, options: options["pixel"]),
        ("arm", 2.0, lambda _, options: options["error_scale"]),
    ],
)
def test_a_setting_is_what_it_says(varied: Varied, value: float, got: object) -> None:
    assert got(*varied_rig(read_rig(UR5), Variation(varied, value))) == value


@pytest.mark.parametrize(
    ("varied", "value", "message"),
    [
        ("cameras", 3, "has 2 cameras"),
        ("leds", 1.5, "is no number of leds"),
        ("pixel", -1, "is not positive"),
        ("poses", 0, "is no number of poses"),
    ],
)
def test_what_a_rig_has_not_is_not_varied(varied: Varied, value: float, message: str) -> None:
    with pytest.raises(SessionError, match=message):
        varied_rig(read_rig(UR5), Variation(varied, value))


def test_one_thing_is_varied_at_a_time() -> None:
    names = [str(setting) for setting in settings_of({"poses": (10, 20), "leds": (3,)})]
    assert names == ["as it is", "poses 10", "poses 20", "leds 3"]


def test_the_command_prints_what_more_noise_costs(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["study", "elbow3r", "--pixel", "0.5", "--seeds", "2", "--processes", "1", "--json"]) == 0
    before, after = json.loads(capsys.readouterr().out)
    assert (before["setting"], after["setting"]) == ("as it is", "pixel 0.5")
    assert after["error"] > before["error"]
    assert after["expected"] > 2.0 * before["expected"]
    assert run(["study", "elbow3r", "--pixel", "a"]) == 2
    assert "numbers with commas between" in capsys.readouterr().err
