"""The report's figures as files, for papers: SVG as they are drawn, or that drawing as PDF or PNG by matplotlib."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from urdfcal import files
from urdfcal.output.figures import FIGURES, figures
from urdfcal.output.svg import figure_svg

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.output.findings import Overview

FOLDER = "figures"
KINDS = ("svg", "pdf", "png")
# The width of a page, 720 units, is 180 mm. [points per unit, pixels per inch]
_POINT, _DPI = 180.0 / 25.4 * 72.0 / 720.0, 300
_SVG = "{http://www.w3.org/2000/svg}"
_COMMAND = re.compile(r"([MLHVhvz])([^MLHVhvz]*)")
_NUMBER = re.compile(r"-?[\d.]+(?:e-?\d+)?")
_INK = {"size": 11 * _POINT, "color": "#222222"}
_ANCHORS = {"start": "left", "middle": "center", "end": "right"}


def earlier_figures(folder: Path) -> tuple[str, ...]:
    """Names of the figures that an earlier run has written into a folder of results, and of nobody's own files."""
    return tuple(
        f"{FOLDER}/{path.name}"
        for path in (folder / FOLDER).glob("*")
        if path.stem in FIGURES and path.suffix[1:] in KINDS
    )


def write_figures(folder: Path, overview: Overview, kind: str) -> None:
    """Write each of the report's figures into a new folder of their own, ``figures``.

    Args:
        folder: of the results.
        overview: what to show.
        kind: one of ``KINDS``; all but svg need matplotlib.

    Raises:
        OutputError: they cannot be written.
    """
    own = folder / FOLDER
    with files.told(own):
        own.mkdir()
    for name, figure in figures(overview).items():
        text = figure_svg(figure)
        files.write_bytes(own / f"{name}.{kind}", text.encode() if kind == "svg" else converted(text, kind))


def converted(svg: str, kind: str) -> bytes:
    """Draw what svg.py has drawn, in the same places, as PDF or PNG; fonts are embedded."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    root = ElementTree.fromstring(svg)  # noqa: S314  # our own
    width, height = (float(number) for number in root.attrib["viewBox"].split()[2:])
    with rc_context({"font.family": "DejaVu Sans", "pdf.fonttype": 42}):
        page = Figure(figsize=(width * _POINT / 72.0, height * _POINT / 72.0))
        axes = page.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(0.0, width), ylim=(height, 0.0))
        axes.axis("off")
        _draw(axes, root, 0.0, 0.0)
        data = io.BytesIO()
        # No date: the same figure is the same file.
        page.savefig(data, format=kind, dpi=_DPI, metadata={"CreationDate": None} if kind == "pdf" else {})
    return data.getvalue()


def _draw(axes: Any, parent: ElementTree.Element, left: float, top: float) -> None:
    """Draw an element's children, its origin being at (left, top), later ones above earlier ones."""
    for element in parent:
        kind, order = element.tag.removeprefix(_SVG), len(axes.get_children())
        if kind == "g":
            u, v = map(float, _NUMBER.findall(element.get("transform", "")))
            _draw(axes, element, left + u, top + v)
        elif kind == "path":
            _draw_path(axes, element, left, top, order)
        elif kind == "text" and len(element):
            _write_legend(axes, element, left, top)
        elif kind == "text":
            text, anchor = "".join(element.itertext()), _ANCHORS[element.get("text-anchor", "start")]
            u, v = left + float(element.get("x", 0)), top + float(element.get("y", 0))
            axes.text(u, v, text, ha=anchor, va="baseline", zorder=order, parse_math=False, **_INK)
        elif kind == "rect" and element.get("x"):
            from matplotlib.patches import Rectangle

            x, y, w, h = (float(element.attrib[name]) for name in ("x", "y", "width", "height"))
            axes.add_patch(Rectangle((left + x, top + y), w, h, color=element.get("fill"), lw=0.0, zorder=order))


def _write_legend(axes: Any, element: ElementTree.Element, left: float, top: float) -> None:
    """Write a text whose parts have colours, right-aligned."""
    from matplotlib.offsetbox import AnnotationBbox, HPacker, TextArea

    parts: list[Any] = [
        TextArea(text or "", textprops={**_INK, "color": color})
        for piece in element
        for text, color in ((piece.text, piece.get("fill")), ((piece.tail or "").rstrip(), _INK["color"]))
    ]
    place = left + float(element.get("x", 0)), top + float(element.get("y", 0))
    row = HPacker(children=parts, pad=0.0, sep=4.0)
    axes.add_artist(AnnotationBbox(row, place, box_alignment=(1.0, 0.2), frameon=False, pad=0.0))


def _draw_path(axes: Any, element: ElementTree.Element, left: float, top: float, order: int) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    points, codes, dots = _points(element.attrib["d"], left, top)
    stroke, fill = element.get("stroke", "none"), element.get("fill", "none")
    width = float(element.get("stroke-width", 1.0)) * _POINT
    if dots:
        axes.plot(*zip(*points, strict=True), "o", ms=width, mew=0.0, color=stroke, zorder=order)
    elif points:
        faint = float(element.get("fill-opacity", 1.0))
        edge, outline = {"edgecolor": stroke, "linewidth": width, "zorder": order}, Outline(points, codes)
        if fill != "none":
            axes.add_patch(PathPatch(outline, facecolor=fill, alpha=faint, linewidth=0.0, zorder=order))
        axes.add_patch(PathPatch(outline, fill=False, capstyle="round", joinstyle="round", **edge))


def _points(d: str, left: float, top: float) -> tuple[list[tuple[float, float]], list[int], bool]:
    """The corners of a path, matplotlib's codes of them (1: begin, 2: line), and whether it is dots."""
    points: list[tuple[float, float]] = []
    codes: list[int] = []
    u = v = 0.0
    start, dots = (0.0, 0.0), d.rstrip().endswith("h0")
    for command, text in _COMMAND.findall(d):
        numbers = [float(number) for number in _NUMBER.findall(text)]
        if command in "ML":
            u, v = numbers
        elif command in "Hh":
            u = numbers[0] if command == "H" else u + numbers[0]
        elif command in "Vv":
            v = numbers[0] if command == "V" else v + numbers[0]
        else:
            u, v = start
        if command == "M":
            start = (u, v)
        if not (dots and command == "h"):
            points.append((left + u, top + v))
            codes.append(1 if command == "M" else 2)
    return points, codes, dots
