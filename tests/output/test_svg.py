from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from urdfcal.output.chart import Chart, Mark, Scale
from urdfcal.output.palette import CALIBRATED
from urdfcal.output.svg import Figure, figure_html, figure_svg


def drawn(*marks: Mark, height: float = 200, **changes: object) -> ElementTree.Element:
    chart = Chart(**{"name": "c", "title": "<a> & b", "x": Scale(0, 1), "y": Scale(0, 1), "marks": marks} | changes)
    return ElementTree.fromstring(figure_svg(Figure([[chart]], height)))  # noqa: S314  # our own


def test_a_page_may_be_dark_and_narrow_and_a_file_is_on_white() -> None:
    chart = Chart(
        "c", "title", Scale(0, 1), Scale(0, 1), [Mark("bars", "b", [[0, 0, 1, 1]], [[0, 1, 1, 0]], CALIBRATED)]
    )
    alone = Figure([[chart, chart], [chart]], 200)
    page, file = figure_html(alone), figure_svg(alone)
    assert page.count("<svg") == 3
    assert 'stroke="var(--calibrated,#12875a)"' in page
    widths = [float(width) for width in re.findall(r'viewBox="0 0 (\d+)', page)]
    assert max(widths) <= 420, "readable on a telephone"
    assert file.count("<svg") == 1
    assert "var(" not in file
    assert 'fill="#ffffff"' in file


def test_a_legend_and_a_label_are_written_and_bars_have_room_for_their_numbers() -> None:
    mark = Mark("lines", "nominal", [0.0, 1.0], [0.0, 1.0], CALIBRATED)
    figure = drawn(mark, legend=("nominal",), labels=((0.5, 0.5, "2 px"),), colors=Scale(0.001, 0.002))
    texts = ["".join(element.itertext()) for element in figure.iter() if element.tag.endswith("}text")]
    assert "\u25cf nominal" in texts
    assert "2 px" in texts
    right = max(float(e.get("x")) + 6.4 * len(e.text or "") for e in figure.iter() if (e.text or "").startswith("0.00"))
    assert right <= float(figure.get("viewBox").split()[2]) + 30.0


def paths(figure: ElementTree.Element, color: str) -> list[str]:
    return [element.get("d") for element in figure.iter() if color in (element.get("stroke"), element.get("fill"))]


def test_fifty_thousand_dots_are_one_element_and_each_spot_appears_once():
    rng = np.random.default_rng(0)
    figure = drawn(Mark("dots", "d", rng.uniform(0, 1, 50_000), np.zeros(50_000), CALIBRATED))
    (path,) = paths(figure, "#12875a")
    assert 1000 < path.count("M") < 10_000


def test_what_is_outside_the_range_is_left_out_or_cut():
    figure = drawn(
        Mark("dots", "d", [0.5, 2.0, np.nan], [0.5, 0.5, 0.5], CALIBRATED),
        Mark("lines", "l", [0.0, 5.0], [0.5, 0.5], (1, 2, 3)),
    )
    (dots,), (line,) = paths(figure, "#12875a"), paths(figure, "#010203")
    assert dots.count("M") == 1
    (start, end) = (float(u) for u in re.findall(r"([\d.]+) [\d.]+", line))
    assert start == 0.0
    assert end < 720


def test_texts_are_escaped_and_ticks_keep_apart():
    figure = drawn(x=Scale(0, 1, names=dict.fromkeys(np.linspace(0, 1, 200).tolist(), "a long name")))
    texts = [element.text for element in figure.iter() if element.tag.endswith("text")]
    assert "<a> & b" in texts
    assert 2 < texts.count("a long name") < 12


def test_of_ticks_that_do_not_fit_all_but_every_second_or_third_go():
    names = {round(0.1 * k, 1): f"{k / 10:.4f}" for k in range(10)}
    places = list(names.values())
    for charts in (2, 3, 4):
        chart = Chart("c", "t", Scale(0, 1, names=names), Scale(0, 1), [])
        svg = ElementTree.fromstring(figure_svg(Figure([[chart, *[replace(chart, axes=False)] * (charts - 1)]], 200)))  # noqa: S314
        shown = [places.index(e.text) for e in svg.iter() if e.text in places]
        assert len(shown) > 1
        assert len(set(np.diff(shown))) == 1, "evenly"


def test_equal_axes_have_one_unit_and_cells_their_colours():
    colors = np.array([[10, 20, 30], [200, 210, 220]], dtype=np.uint8)
    figure = drawn(Mark("cells", "m", [0.25, 0.75], [0.5, 0.5], colors, 0.5), equal=True, colors=Scale(0, 2))
    assert len(sides(figure)) == 2
    assert all(width == pytest.approx(height, abs=0.2) for width, height in sides(figure))


def sides(figure: ElementTree.Element) -> list[tuple[float, float]]:
    """Widths and heights of cells."""
    paths = " ".join(p for e in figure.iter() if (p := e.get("d")))
    found = [[float(x) for x in of] for of in re.findall(r"M([\d.]+) ([\d.]+)H([\d.]+)V([\d.]+)H[\d.]+z", paths)]
    return [(right - left, bottom - top) for left, top, right, bottom in found]


def test_cells_end_with_their_chart() -> None:
    cells = Mark("cells", "m", [0.25, 0.75, 0.25], [0.1, 0.1, -0.1], (1, 2, 3), 0.5)
    whole, cut, beyond = sorted(sides(drawn(cells, equal=True)), key=lambda side: -side[1])
    assert whole == cut
    assert whole[1] == pytest.approx(0.7 * whole[0], abs=0.2), "from -0.15 on, it is drawn from 0 to 0.35"
    assert beyond[1] == pytest.approx(0.3 * whole[0], abs=0.2), "a cell whose middle is outside reaches into it"


def test_rows_of_names_are_as_high_as_their_text_whatever_stands_below() -> None:
    names = {float(k): f"joint {k}" for k in range(1, 6)}
    for label in ("", "how far [mm]"):
        figure = drawn(y=Scale(0.3, 5.7, names=names), x_label=label, height=10.0)
        at = sorted(float(e.get("y")) for e in figure.iter() if (e.text or "").startswith("joint"))
        assert min(np.diff(at)) > 11.0
