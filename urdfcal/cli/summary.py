"""What ``urdfcal calibrate`` prints of a result: assessment, numbers, corrections, remarks and files."""

from __future__ import annotations

from math import floor, isfinite, log10
from typing import TYPE_CHECKING, Any

from urdfcal.cli.console import INDENT, sheet, terminal
from urdfcal.typography import lines_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from urdfcal.output.findings import Overview
    from urdfcal.result.fitted import FittedCalibration

# A summary that is longer scrolls its assessment away.
_MOST_LINES, _MOST_ROWS, _MOST_REMARKS, _FILES = 25, 8, 6, 3
_ANY = 10_000  # columns: a terminal on which nothing is narrow


def print_summary(overview: Overview, paths: Sequence[Path], remarks: Sequence[str]) -> None:
    """Print assessment, numbers, corrections, warnings and files.

    Of remarks that speak against nothing only as many as 25 lines hold. Nothing is cut: on a narrow terminal lines
    continue on the next one, and the table is set closer.

    Args:
        overview: of the result.
        paths: the files that were written.
        remarks: on writing them.
    """
    from urdfcal.output.findings import claims, counted, headline, look_up, meaning, residual_rows
    from urdfcal.output.placed import placed
    from urdfcal.output.texts import unseen
    from urdfcal.session.exclusion import summary

    console = terminal()
    screen = console.is_terminal
    document, calibration = overview.document, overview.calibration
    assessment = calibration.assessment
    fit, (low, high) = document["fit"], document["validation"]["interval_mm"]

    printed = 0

    def line(text: str, style: str = "") -> None:
        # Piped, a line is as long as it is.
        nonlocal printed
        rows = lines_of(text, console.width, INDENT) if screen else [text]
        printed += len(rows)
        console.print("\n".join(rows), style=style, markup=False, soft_wrap=True)

    tone = {"good": "bold green", "doubtful": "bold yellow", "bad": "bold red"}[assessment.level]
    line(f"{calibration.chain.name}: {assessment.sentence}", tone)
    interval = f"(95 %: {low:.3g} to {high:.3g})"
    line(f"{headline(document)} {interval} {meaning(document)}, nominal -> calibrated", "bold")
    for claim in claims(document):
        line(claim)
    parts = [
        f"{look_up(document, row.nominal):.3f} -> {look_up(document, row.calibrated):.3f} {row.unit} {row.what}"
        for row in residual_rows(document)
    ]
    chi2 = fit["reduced_chi2"]
    noise = f", {chi2**0.5:.2g} times the declared noise" if chi2 is not None else ""
    line(f"residual rms {', '.join(parts)}{noise}")
    excluded = summary(calibration.session.excluded.named)
    excluded = f" ({excluded})" if excluded else ""
    empty = f" ({without} more without a measurement)" if (without := unseen(overview)) else ""
    counts = f"{fit['poses']} {counted(document)}{empty}{excluded}, {fit['observations']} measured numbers"
    cut = _outliers(document["outliers"])
    line(f"{counts}, {fit['parameters']} parameters ({calibration.comparison.chosen.spec}), {cut}")
    sessions = []
    for name, session in document.get("sessions", {}).items():
        found = ", ".join(f"{each['rms']:.3f} {each['unit']}" for each in session["residuals"])
        sessions.append(f"{name}: {session['poses']} poses, {found} rms")
    if sessions:
        line("; ".join(sessions))
    cameras = document["cameras"].items()
    clocks = [f"{name} {_clock(**camera['time_offset'])}" for name, camera in cameras if "time_offset" in camera]
    if clocks:
        line(f"time offsets, robot less camera: {', '.join(clocks)}")
    shutters = [f"{name} {_row_time(**camera['line_time'])}" for name, camera in cameras if "line_time" in camera]
    if shutters:
        line(f"rolling shutters, from row to row: {', '.join(shutters)}")
    rows, places = len(calibration.geometry.labels), placed(calibration)
    for place in places:
        line(place)
    if rows <= _MOST_ROWS and not places:
        printed += _print_corrections(calibration, console)
    elif rows > _MOST_ROWS:
        line(f"{rows} rows of offsets: in the report and in calibration.json")
    unidentifiable = [f"unidentifiable: {lost}" for lost in document["identifiability"]["lost"]]
    # What the verdict wants to have checked stands out, in print as well.
    texts = [(f"! {reason}", tone) for reason in assessment.reasons]
    texts += [(f"- {text}", "") for text in (*remarks, *unidentifiable)]
    # What speaks against the result, or is missing in its files, is not left out for want of lines.
    room = min(_MOST_REMARKS, max(_MOST_LINES - _FILES - printed, len(assessment.reasons) + len(remarks) + 1))
    if len(texts) > room:
        texts = [*texts[: room - 1], (f"- {len(texts) - room + 1} more remarks in the report", "")]
    for text, style in texts:
        line(text, style)
    for path in paths:
        if path.suffix != ".json":
            line(str(path) if path.suffix != ".rrd" else f"{path}   (urdfcal view {path.parent})")


def _clock(value: float, sigma: float | None) -> str:
    """A camera's time offset, given in s."""
    return f"{1e3 * value:.3g} (fixed)" if sigma is None else f"{1e3 * value:+.2f} ± {1e3 * sigma:.2f} ms"


def _row_time(value: float, sigma: float | None) -> str:
    """A camera's line time, given in s."""
    return f"{1e6 * value:.4g} us (given)" if sigma is None else f"{1e6 * value:.2f} ± {1e6 * sigma:.2f} us"


def _outliers(outliers: Sequence[Mapping[str, Any]]) -> str:
    """How many measurements were taken out, and the one that is farthest off."""
    if not outliers:
        return "0 outliers"
    worst = max(outliers, key=lambda of: of["sigmas"])
    where = " ".join(filter(None, ("pose", worst["pose"], worst["camera"], worst["led"])))
    size = f"{where} by {worst['residual']:.3g} {'px' if worst['camera'] else 'mm'}"
    return f"1 outlier, {size}" if len(outliers) == 1 else f"{len(outliers)} outliers, the farthest {size}"


def _print_corrections(calibration: FittedCalibration, console: Console) -> int:
    """Print the table of corrections, on a narrow terminal closely set; return its number of lines."""
    table = _corrections(calibration, compact=False)
    if console.measure(table, options=console.options.update(max_width=_ANY)).maximum > console.width:
        table = _corrections(calibration, compact=True)
    lines = console.render_lines(table)
    console.print(table)
    return len(lines)


def _corrections(calibration: FittedCalibration, *, compact: bool) -> Table:
    from urdfcal.estimation.blocks.arm import LENGTHS

    between = "\n" if compact else " "
    columns = [f"{name}{between}({'mm' if name in LENGTHS else 'mrad'})" for name in calibration.geometry.columns]
    title = "offsets (standard deviation of the last digits)" if compact else "offsets ± standard deviation"
    table = sheet(title, ["joint", *columns])
    written = _in_brackets if compact else _beside
    for joint, offsets, sigmas in zip(
        calibration.geometry.labels, 1e3 * calibration.estimate.offsets, 1e3 * calibration.sigmas(), strict=True
    ):
        cells = [written(o, s) if isfinite(s) else "" for o, s in zip(offsets, sigmas, strict=True)]
        table.add_row(joint, *cells)
    if compact:
        table.padding = (0, 1, 0, 0)
        # The joints' names may be longer than what is left for them, the numbers may not.
        table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
        for column in table.columns[1:]:
            column.no_wrap = True
    return table


def _beside(value: float, sigma: float) -> str:
    return f"{value:.3f} ± {sigma:.3f}"


def _in_brackets(value: float, sigma: float) -> str:
    """Write a value with its standard deviation in units of its last digits, two of them: 2.528(51).

    At most three decimals, as without brackets.
    """
    digits = min(max(1 - floor(log10(sigma)), 0), 3) if sigma > 0.0 else 3
    shown = round(sigma * 10**digits)
    if shown >= 100 and digits:  # rounded up to three digits
        digits, shown = digits - 1, round(sigma * 10 ** (digits - 1))
    return f"{value:.{digits}f}({shown})"
