"""The report's figures as files."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from urdfcal.cli import run
from urdfcal.errors import OutputError
from urdfcal.output.chart import Chart, Mark, Scale
from urdfcal.output.figure_files import converted
from urdfcal.output.figures import FIGURES
from urdfcal.output.palette import CALIBRATED
from urdfcal.output.svg import Figure, figure_svg

if TYPE_CHECKING:
    from pathlib import Path

GREEN = np.array([0x5A, 0x87, 0x12])  # blue first


def drawn() -> str:
    marks = [
        Mark("dots", "d", [0.5], [0.5], CALIBRATED),
        Mark("bars", "b", [[0.7, 0.7, 0.9, 0.9]], [[0, 0.8, 0.8, 0]], (0, 0, 255)),
    ]
    return figure_svg(
        Figure([[Chart("c", "title", Scale(0, 1), Scale(0, 1), marks, legend=("d",), x_label="\u03b1 [mrad]")]], 200)
    )


def test_a_png_has_everything_where_the_svg_has_it() -> None:
    svg = drawn()
    width, height = (float(n) for n in re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg).groups())  # type: ignore[union-attr]
    picture = cv2.imdecode(np.frombuffer(converted(svg, "png"), np.uint8), cv2.IMREAD_COLOR)
    scale = picture.shape[1] / width
    assert picture.shape[0] / height == pytest.approx(scale, rel=0.01)
    (left, top), (u, v) = (
        tuple(float(n) for n in re.search(pattern, svg).groups())  # type: ignore[union-attr]
        for pattern in (r'<g transform="translate\(([\d.]+) ([\d.]+)\)"><text', r'd="M([\d.]+) ([\d.]+)h0"')
    )
    x, y = round(scale * (left + u)), round(scale * (top + v))
    assert np.abs(picture[y, x].astype(int) - GREEN).max() < 30
    assert picture[-2, -2].min() == 255, "white ground"
    bars = (picture[..., 0] > 150) & (picture[..., 2] < 200)
    assert bars.any()


def test_a_pdf_has_its_fonts_and_no_date() -> None:
    data = converted(drawn(), "pdf")
    assert data.startswith(b"%PDF")
    assert b"FontFile2" in data
    assert b"CreationDate" not in data
    assert converted(drawn(), "pdf") == data


def test_calibrate_writes_them_and_replaces_those_of_an_earlier_run(
    small_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, out = str(small_session), tmp_path / "out"
    assert run(["calibrate", session, "-o", str(out), "--figures", "png"]) == 0
    assert {path.suffix for path in (out / "figures").iterdir()} == {".png"}
    (out / "figures" / "mine.txt").write_text("mine")
    assert run(["calibrate", session, "-o", str(out), "--figures", "svg"]) == 0
    names = {path.name for path in (out / "figures").iterdir()}
    assert {name.partition(".")[0] for name in names} <= {*FIGURES, "mine"}
    assert {"fields.svg", "workspace.svg", "corrections.svg", "causes.svg", "mine.txt"} <= names
    assert not any(name.endswith(".png") for name in names)
    assert "earlier result" not in capsys.readouterr().out
    assert run(["export", str(out), "--to", "dh-csv"]) == 0
    assert run(["calibrate", session, "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "of an earlier result, to be exported anew: dh.csv, dh_frames.csv" in said
    assert "figures is of an earlier result" in said


def test_a_figure_that_cannot_be_drawn_leaves_the_earlier_result_whole(
    small_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, out = str(small_session), tmp_path / "out"
    assert run(["calibrate", session, "-o", str(out), "--figures", "svg"]) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    def fail(svg: str, kind: str) -> bytes:
        raise OutputError("cannot write here: no room", where=kind)

    monkeypatch.setattr("urdfcal.output.figure_files.converted", fail)
    assert run(["calibrate", session, "-o", str(out), "--figures", "png", "--seed", "1"]) == 2
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_a_file_in_the_place_of_the_figures_is_told_and_nothing_is_written(
    small_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, out = str(small_session), tmp_path / "out"
    out.mkdir()
    (out / "figures").write_text("mine")
    assert run(["calibrate", session, "-o", str(out), "--figures", "svg"]) == 2
    assert "figures is a file" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["figures"]


def test_without_matplotlib_it_is_refused_before_anything_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert run(["calibrate", "nowhere", "-o", str(tmp_path / "o"), "--figures", "pdf"]) == 2
    assert "pip install 'urdfcal[figures]', or take svg" in capsys.readouterr().err
