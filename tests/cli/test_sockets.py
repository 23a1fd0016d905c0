"""An arm that touches things, from files to results: no camera, no tracker."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from tests.touching import KINDS, touched
from urdfcal.cli import run
from urdfcal.estimation.measurements import Contacts, Distances, Planes
from urdfcal.io.folder import read_session
from urdfcal.io.writing import write_session
from urdfcal.result.calibration import Calibration

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.estimation.measurements import Measurement

NOMINAL = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"


@pytest.fixture(scope="module")
def folder(calibrated: Callable[[str], Path]) -> Path:
    return calibrated("panda_sockets")


def evaluated(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    assert run(["evaluate", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


class TestSimulated:
    def test_the_arm_comes_near_the_true_one(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        session, result = folder / "session", folder / "result"
        urdfs = (NOMINAL, result / "panda_calibrated.urdf")
        tips = [evaluated(capsys, of, session / "truth.urdf", "--tip", "panda_hand")["position_mm"] for of in urdfs]
        assert tips[1]["rms"] < 0.5 * tips[0]["rms"]

    def test_places_are_written_and_true_up_to_what_contacts_alone_cannot_tell(self, folder: Path) -> None:
        places = Calibration.load(folder / "result").to_dict()["places"]
        truth = json.loads((folder / "session" / "truth.json").read_text())["places"]
        assert places.keys() == truth.keys()
        found, true = (np.array([of[name] for name in places]) for of in (
            {name: place["position"] for name, place in places.items()}, truth
        ))  # fmt: skip
        sigma = np.array([place["sigma"] for place in places.values()])
        assert np.abs(found - true).max() < 3e-3
        assert (sigma > 0.0).all()
        apart = [np.linalg.norm(np.diff(found[k : k + 2], axis=0)) for k in range(0, len(found), 2)]
        np.testing.assert_allclose(apart, 0.05, atol=3e-4)

    def test_a_result_or_its_document_or_its_urdf_explains_the_session(
        self, folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        session, result = folder / "session", folder / "result"
        as_calibrated, by_document, by_urdf, drawn = (
            evaluated(capsys, of, session)
            for of in (result, result / "calibration.json", result / "panda_calibrated.urdf", NOMINAL)
        )
        for of in (as_calibrated, by_urdf, drawn):
            residual = of["residual_mm"]
            assert {"rms", "median", "p95", "max"} <= residual.keys()
            assert residual["sightings"] == len(read_session(session).measurements[0])
        assert by_document["residual_mm"] == as_calibrated["residual_mm"]
        # The ball is where the calibration has it, or wherever it fits best.
        assert by_urdf["residual_mm"]["rms"] <= as_calibrated["residual_mm"]["rms"] < 0.5
        assert drawn["residual_mm"]["rms"] > 4.0 * by_urdf["residual_mm"]["rms"]
        found = [of["found_mm"] for of in as_calibrated["place_distances"]]
        np.testing.assert_allclose(found, 50.0, atol=0.4)
        assert len(set(found)) == len(found)  # the known ones take no part
        places = as_calibrated["places"]
        for known in as_calibrated["place_distances"]:
            ends = [places[name] for name in known["places"]]
            assert known["found_mm"] == pytest.approx(1e3 * np.linalg.norm(np.subtract(*ends)))
        assert run(["evaluate", str(result), str(session)]) == 0
        assert re.search(r"front_0 to front_1: 50\.\d+ mm, known as 50\.000 mm|49\.\d+ mm", capsys.readouterr().out)

    def test_a_ball_that_was_fastened_anew_is_fitted(
        self, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        document = json.loads((folder / "result" / "calibration.json").read_text())
        document["leds"]["ball"]["position"][2] += 0.005
        (tmp_path / "other.json").write_text(json.dumps(document))
        here, there, anew = (
            evaluated(capsys, of, folder / "session")
            for of in (
                folder / "result" / "panda_calibrated.urdf",
                folder / "result",
                tmp_path / "other.json",
            )
        )
        assert anew["residual_mm"]["rms"] == pytest.approx(here["residual_mm"]["rms"], rel=1e-6)
        assert anew["residual_mm"]["rms_nominal"] == there["residual_mm"]["rms_nominal"]
        assert run(["evaluate", str(tmp_path / "other.json"), str(folder / "session")]) == 0
        said = capsys.readouterr().err
        assert re.search(r"LEDs are up to \d\.?\d* mm from where the calibration found them, which explains", said)
        assert run(["evaluate", str(folder / "result"), str(folder / "session")]) == 0
        assert "LEDs are up to" not in capsys.readouterr().err

    def test_it_says_whose_lengths_count(
        self, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert run(["calibrate", str(folder / "session"), "-o", str(tmp_path / "known")]) == 0
        assert "if the known distances are right: 0.1 % of them is" in capsys.readouterr().out
        write_session(tmp_path / "bare", replace(read_session(folder / "session"), place_distances=()))
        assert run(["calibrate", str(tmp_path / "bare"), "-o", str(tmp_path / "unknown")]) == 0
        assert "lengths are those of the nominal arm within its tolerances" in capsys.readouterr().out

    def test_verify_judges_by_contacts(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["verify", str(folder / "result"), str(folder / "session"), "--limit", "1mm", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["rms_mm"] < 0.6

    def test_pixels_and_outliers_are_a_cameras(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for option in ("--pixel", "--outliers"):
            assert run(["simulate", "panda_sockets", "-o", str(tmp_path / "x"), option, "0.1"]) == 2
            assert "the rig touches places" in capsys.readouterr().err
        assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.kind)
def test_each_kind_alone_is_calibrated_and_reported(
    kind: type[Measurement], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_session(tmp_path / "session", touched(kind, 100).session)
    assert run(["calibrate", str(tmp_path / "session"), "-o", str(tmp_path / "result"), "--force", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["fit"]["residuals"][0]["kind"] == kind.kind
    assert document["fit"]["residuals"][0]["unit"] == "mm"
    assert (tmp_path / "result" / "report.html").is_file()
    assert (tmp_path / "result" / "calibration.rrd").is_file()
    assert len(document["planes" if kind is Planes else "places"]) == 4
    if kind is Planes:
        normals = np.array([plane["normal"] for plane in document["planes"].values()])
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)


def test_kinds_of_one_unit_are_told_together_and_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    contacts, planes = (touched(kind, 40).session for kind in (Contacts, Planes))
    (table,) = planes.measurements
    session = replace(
        contacts,
        poses=tuple(f"{k}" for k in range(len(contacts.poses) + len(planes.poses))),
        q=np.vstack([contacts.q, planes.q]),
        previous=None,
        measurements=(*contacts.measurements, replace(table, pose=table.pose + len(contacts.poses))),
        noise=replace(contacts.noise, other={"contact": 1e-4, "plane": 1e-4}),
    )
    write_session(tmp_path / "session", session)
    found = evaluated(capsys, NOMINAL, tmp_path / "session")
    parts = [found[f"residual_{kind}_mm"] for kind in ("contacts", "planes")]
    total = sum(part["sightings"] * part["rms"] ** 2 for part in parts)
    assert found["residual_mm"]["rms"] == pytest.approx(np.sqrt(total / found["residual_mm"]["sightings"]))


BAD: tuple[tuple[type[Measurement], Callable[[str], str], str], ...] = (
    (Contacts, lambda text: text.replace("place", "socket", 1), r"contacts.csv:1: unknown column 'socket'.*place"),
    (Contacts, lambda text: text.replace("ball", "bowl", 1), r"contacts.csv:2:\d+: there is no led 'bowl'.*ball"),
    (Contacts, lambda text: text.replace("p0,", "q0,", 1), r"contacts.csv:2:1: there is no pose 'q0'"),
    (Contacts, lambda text: text + text.splitlines()[1] + "\n", r"contacts.csv:\d+:1: .* already in line 2"),
    (Contacts, lambda text: text.replace("place3", "", 1), r"contacts.csv:\d+:\d+: place: the cell is empty"),
    (Planes, lambda text: text.replace("plane0\n", "\n", 1), r"planes.csv:2:\d+: plane: the cell is empty"),
    (Distances, lambda text: re.sub(r",0\.\d+\n", ",nan\n", text, count=1), r"distances.csv:2:\d+: distance: nan"),
    (Distances, lambda text: re.sub(r",(0\.\d+)\n", r",-\1\n", text, count=1), r"distances.csv:2:\d+: .* not positive"),
    (
        Distances,
        lambda text: re.sub(r",0\.(\d{3})\d*\n", r",\1.0\n", text, count=1),
        r"distances.csv:2:\d+: a distance of \d+ m looks like millimetres.*Write metres",
    ),
)


@pytest.mark.parametrize(("kind", "break_it", "message"), BAD)
def test_bad_tables_are_refused_with_their_place(
    kind: type[Measurement],
    break_it: Callable[[str], str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_session(tmp_path / "session", touched(kind, 40).session)
    table = tmp_path / "session" / f"{kind.kind}.csv"
    text = table.read_text()
    assert break_it(text) != text
    table.write_text(break_it(text))
    assert run(["calibrate", str(tmp_path / "session"), "-o", str(tmp_path / "result")]) == 2
    assert re.search(message, capsys.readouterr().err.replace("\n", " "))
    assert not (tmp_path / "result").exists()


class TestChecks:
    def test_known_distances_of_places_are_written_and_read(self, tmp_path: Path) -> None:
        session = touched(Contacts, 40).session
        write_session(tmp_path / "session", session)
        assert read_session(tmp_path / "session").place_distances == session.place_distances != ()

    def test_a_place_that_is_touched_once_tells_nothing_and_is_left_out(self, tmp_path: Path) -> None:
        session = tmp_path / "session"
        write_session(session, touched(Contacts, 40).session)
        table = session / "contacts.csv"
        table.write_text(table.read_text().replace("place3", "once", 1))
        found = read_session(session)
        assert len(found.measurements[0]) == 39
        (warning,) = [text for text in found.warnings if "too seldom" in text]
        assert re.search(
            r"contacts.csv:\d+:\d+: measured too seldom .*where the place is: once: left out; measure each", warning
        )
        assert warning.endswith("in 2 poses or more, and mind the spelling")

    def test_a_place_that_is_left_out_is_in_no_result(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        session, result = tmp_path / "session", tmp_path / "result"
        write_session(session, touched(Contacts, 60).session)
        table, file = session / "contacts.csv", session / "session.yaml"
        table.write_text(table.read_text().replace("place3", "once", 1))
        content = yaml.safe_load(file.read_text())
        content["place_distances"].append({"places": ["place2", "once"], "distance": 0.3, "sigma": 1e-4})
        file.write_text(yaml.safe_dump(content))
        assert run(["calibrate", str(session), "-o", str(result), "--force"]) == 0
        document = json.loads((result / "calibration.json").read_text())
        assert set(document["places"]) == set(re.findall(r"place\d", table.read_text()))
        assert all(place["sigma"] is not None for place in document["places"].values())
        capsys.readouterr()
        assert run(["evaluate", str(result), str(session), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert "once" not in found["places"]
        assert all("once" not in of["places"] for of in found["place_distances"])

    @pytest.mark.parametrize(("kind", "most"), [(Contacts, 1), (Planes, 3)])
    def test_nothing_but_such_is_refused(self, kind: type[Measurement], most: int, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
        session = tmp_path / "session"
        write_session(session, touched(kind, 4 * most).session)
        assert run(["calibrate", str(session), "-o", str(tmp_path / "result")]) == 2
        assert f"in {most + 1} poses or more" in capsys.readouterr().err.replace("\n", " ")

    def test_a_bar_of_one_length_is_no_frozen_recording(self, tmp_path: Path) -> None:
        data = touched(Distances, 40).session
        (table,) = data.measurements
        write_session(
            tmp_path / "session", replace(data, measurements=(replace(table, distance=np.full((40, 1), 0.4)),))
        )
        assert read_session(tmp_path / "session").warnings == ()

    def test_known_distances_need_their_places(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        session = tmp_path / "session"
        write_session(session, touched(Contacts, 40).session)
        path = session / "session.yaml"
        keys = yaml.safe_load(path.read_text())
        for places, message in (
            (["place0", "place9"], "there is no place 'place9'.*place1"),
            (["place0", "place0"], "a place has no distance to itself"),
        ):
            known = [{"places": places, "distance": 0.05, "sigma": 1e-4}]
            path.write_text(yaml.safe_dump(keys | {"place_distances": known}))
            assert run(["calibrate", str(session), "-o", str(tmp_path / "result")]) == 2
            assert re.search(message, capsys.readouterr().err.replace("\n", " "))
        write_session(tmp_path / "planes", touched(Planes, 40).session)
        path = tmp_path / "planes" / "session.yaml"
        known = [{"places": ["a", "b"], "distance": 0.05, "sigma": 1e-4}]
        path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"place_distances": known}))
        assert run(["calibrate", str(tmp_path / "planes"), "-o", str(tmp_path / "result")]) == 2
        assert "nothing that names places" in capsys.readouterr().err.replace("\n", " ")

    def test_a_scale_belongs_to_what_measures_lengths(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        session = tmp_path / "session"
        write_session(session, replace(touched(Contacts, 40).session, scale_sigma=1e-3))
        assert run(["calibrate", str(session), "-o", str(tmp_path / "result")]) == 2
        assert "nothing here measures any" in capsys.readouterr().err.replace("\n", " ")
        write_session(tmp_path / "bar", replace(touched(Distances, 40).session, scale_sigma=1e-3))
        assert read_session(tmp_path / "bar").scale_sigma == 1e-3

    def test_a_rig_has_cameras_or_places(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        rig = {"robot": {"urdf": "package://x", "tip_link": "tool"}, "leds": {"ball": {"position": [0, 0, 0.1]}}}
        (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
        assert run(["simulate", str(tmp_path), "-o", str(tmp_path / "x")]) == 2
        assert "neither cameras nor places" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.no_cover
def test_measured_sockets_one_tool_place_left_out(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A Franka Panda, the tool at eight places: the ball's distance from sockets that no calibration has seen."""
    source = shared / "panda_sockets"
    if not source.is_dir():
        pytest.skip(f"the measured data are not here: {source}")
    rows = (source / "contacts.csv").read_text().splitlines()
    keys = yaml.safe_load((source / "session.yaml").read_text())
    keys["robot"]["base_link"] = "panda_link0"  # it names a link that the URDF has not
    for name, left in (("rest", False), ("left", True)):
        folder = tmp_path / name
        folder.mkdir()
        for file in ("panda.urdf", "joints.csv"):
            (folder / file).write_bytes((source / file).read_bytes())
        chosen = [row for row in rows[1:] if row.split(",")[2].startswith("mid_left") == left]
        (folder / "contacts.csv").write_text("\n".join([rows[0], *chosen]) + "\n")
        known = [of for of in keys["place_distances"] if of["places"][0].startswith("mid_left") == left]
        (folder / "session.yaml").write_text(yaml.safe_dump(keys | {"place_distances": known}))
    assert run(["calibrate", str(tmp_path / "rest"), "-o", str(tmp_path / "result"), "-q"]) == 0
    found, drawn = (evaluated(capsys, of, tmp_path / "left") for of in (tmp_path / "result", source / "panda.urdf"))
    assert drawn["residual_mm"]["rms"] > 8.0
    assert found["residual_mm"]["rms"] < 0.34
    assert found["place_distances"][0]["found_mm"] == pytest.approx(50.0, abs=0.16)


@pytest.mark.no_cover
def test_of_a_few_distances_no_ball_is_said_to_be_fastened_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Of four lengths to one place any ball explains all: there residuals vanish, which tells nothing of where it is.
    write_session(tmp_path / "session", touched(Distances, 60).session)
    assert run(["calibrate", str(tmp_path / "session"), "-o", str(tmp_path / "result"), "--force", "-q"]) == 0
    other = touched(Distances, 60, 1).session
    (table,) = other.measurements
    few = other.at(table.pose[np.flatnonzero(table.index["place"] == 0)[:4]])
    write_session(tmp_path / "few", replace(few, place_distances=()))
    assert run(["evaluate", str(tmp_path / "result"), str(tmp_path / "few")]) == 0
    assert "LEDs are up to" not in capsys.readouterr().err
