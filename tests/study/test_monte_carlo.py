from __future__ import annotations

import csv
import json
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.recorded import Recorded
from urdfcal.arrays import inverse
from urdfcal.cli import run
from urdfcal.errors import SessionError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.study import monte_carlo
from urdfcal.study.charts import study_charts
from urdfcal.study.monte_carlo import Outcome, Run, Variation, present, run_one, settings_of, varied_rig
from urdfcal.study.results import as_csv, remarks, rows, write_study

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.study.monte_carlo import Varied

UR5 = find_rig("ur5")


@pytest.mark.no_cover
def test_a_run_is_the_same_in_whatever_order_and_expects_what_comes() -> None:
    runs = [Run(find_rig("elbow3r"), Variation("poses", 20), seed) for seed in range(4)]
    there = np.array([run_one(run) for run in runs])
    np.testing.assert_array_equal(run_one(runs[1]), there[1])
    nominal, error, expected = np.sqrt(np.mean(there**2, axis=0))
    assert error < 0.2 * nominal
    assert 0.5 * expected < error < 2.0 * expected


@pytest.mark.no_cover
def test_an_arm_that_bends_is_judged_with_its_bending(tmp_path: Path) -> None:
    rig = tmp_path / "rig"
    shutil.copytree(UR5, rig)
    said = (rig / "rig.yaml").read_text() + "errors: {compliance: 1.0e-4}\n"
    (rig / "rig.yaml").write_text(said)
    nominal, error, _ = run_one(Run(rig, Variation("arm", 1e-6), 0))
    assert nominal > 5e-4  # all of it is sag: the geometry is as drawn
    (rig / "rig.yaml").write_text(said + "joint_models: {compliance: off}\n")
    _, rigid, _ = run_one(Run(rig, Variation("arm", 1e-6), 0))
    assert error < 0.5 * rigid


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


@pytest.mark.no_cover
def test_the_command_prints_and_writes_what_more_noise_costs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ["--pixel", "0.5", "--seeds", "2", "--processes", "1", "--json", "-o", str(tmp_path / "out")]
    assert run(["study", "elbow3r", *more]) == 0
    before, after = json.loads(capsys.readouterr().out)
    assert (before["setting"], after["setting"]) == ("as it is", "pixel 0.5")
    assert before["poses"] == 50
    with (tmp_path / "out" / "study.csv").open() as file:
        as_it_is, noisier = csv.DictReader(file)
    assert (as_it_is["varied"], noisier["varied"], float(noisier["value"])) == ("", "pixel", 0.5)
    assert [float(row["error"]) for row in (as_it_is, noisier)] == [before["error"], after["error"]]
    assert {row["poses"] for row in (as_it_is, noisier)} == {"50"}
    page = (tmp_path / "out" / "study.html").read_text()
    assert f'<td class="n">{1e3 * after["error"]:.3g}</td>' in page
    assert page.count("<svg") == 1
    recorded = Recorded(tmp_path / "out" / "study.rrd")
    assert "/base/charts/study\\ pixel/rms" in recorded.entities
    (table,) = recorded.static("/base/texts/table", "TextDocument:text")
    assert f"| pixel 0.5 | 50 | {1e3 * after['error']:.3g} |" in table
    assert after["error"] > before["error"]
    assert after["expected"] > 2.0 * before["expected"]
    assert run(["study", "elbow3r", "--pixel", "a"]) == 2
    assert "numbers with commas between" in capsys.readouterr().err
    assert run(["study", "elbow3r", "--scheduler", "tcp://nowhere:1"]) == 2
    assert "--scheduler goes with --engine dask" in capsys.readouterr().err


def test_a_place_that_cannot_be_written_is_refused_before_the_first_simulation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(monte_carlo, "study", lambda *_, **__: pytest.fail("it was simulated"))
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "nowhere" / "out"):
        assert run(["study", "elbow3r", "-o", str(place)]) == 2
        assert f"{place}: cannot write here" in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_what_came_out_is_printed_even_where_it_cannot_be_written(
    more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def study(*_: object, **__: object) -> list[Outcome]:
        (tmp_path / "out").write_text("")  # meanwhile someone put a file there
        return [Outcome(Variation(None, 1.0), 50, 1e-3, 2e-3, 1e-3, 5e-3, (1e-3,), ())]

    monkeypatch.setattr(monte_carlo, "study", study)
    assert run(["study", "elbow3r", "-o", str(tmp_path / "out"), *more]) == 2
    said = capsys.readouterr()
    assert "as it is" in said.out
    assert ("1 in 10 above: of ten arms or more" in said.out) is (not more)
    assert "out: cannot write here" in " ".join(said.err.split())


def test_where_no_arm_can_be_simulated_the_reason_is_written() -> None:
    failed = Outcome(Variation("leds", 3), 50, *[float("nan")] * 4, (), ("no pose shows them",))
    assert as_csv([failed]).splitlines()[1] == "leds,3,50,0,,,,,no pose shows them"
    assert rows([failed]) == [("leds 3", "50", "", "", "", "", "0")]
    assert study_charts(read_rig(UR5), [failed]) == ()


def test_one_arm_in_ten_is_said_of_ten_arms_and_the_recording_says_what_dots_are(tmp_path: Path) -> None:
    few, many = (Outcome(Variation("leds", 3), 50, 1e-3, 2e-3, 1.5e-3, 5e-3, (1e-3,) * count, ()) for count in (9, 10))
    assert [row[3] for row in rows([few, many])] == ["", "2"]
    write_study(tmp_path, read_rig(UR5), [many], 0)
    (text,) = Recorded(tmp_path / "study.rrd").static("/base/texts/table", "TextDocument:text")
    assert "Dots: the tip's error of each arm; green: their rms" in text
    assert "expected (mm)" in text
    assert (remarks([few, many]), remarks([many])) == (["1 in 10 above: of ten arms or more (--seeds)"], [])
    assert remarks([few])[0] not in text
    write_study(tmp_path, read_rig(UR5), [few], 0)
    (text,) = Recorded(tmp_path / "study.rrd").static("/base/texts/table", "TextDocument:text")
    assert f"- {remarks([few])[0]}" in text
    assert [chart.title for chart in study_charts(read_rig(UR5), [many])] == ["Tip error by LEDs [mm]"]


@pytest.mark.parametrize(
    ("varied", "value"), [("poses", 50), ("pixel", 0.1), ("baseline", 1), ("cameras", 2), ("leds", 1), ("arm", 1)]
)
def test_the_rig_as_it_is_is_one_of_a_charts_values(varied: Varied, value: float) -> None:
    assert present(read_rig(UR5), varied) == value
