"""``urdfcal detect`` and ``calibrate``: the LEDs in a session's images; a session in, a corrected URDF out."""

from __future__ import annotations

import importlib.util
import io
import json
import sys
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any, Literal

import click

from urdfcal.cli.console import PATH, progress_bar, say, seed_option, status_line
from urdfcal.cli.summary import print_summary
from urdfcal.errors import CalibrationError, OutputError

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.images.files import Colour
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session

Report = Literal["text", "json", "nothing"]

# As in urdfcal.images.files, which takes long to import.
_COLOURS = ("any", "red", "green", "blue")
# As in urdfcal.output.figure_files.
_FIGURES = ("svg", "pdf", "png")


def _drawable(ctx: click.Context, param: click.Parameter, kind: str | None) -> str | None:
    """Refuse a kind of figure now that nothing here can draw in the end."""
    del ctx, param
    if kind not in (None, "svg") and importlib.util.find_spec("matplotlib") is None:
        raise click.BadParameter(f"{kind} needs matplotlib: pip install 'urdfcal[figures]', or take svg")
    return kind


@click.command("detect")
@click.argument("session", type=PATH)
@click.option("--colour", type=click.Choice(_COLOURS), default="any", help="Of the LED, in colour images.")
@click.option("--debug-images", type=PATH, help="Folder for drawings of what was found in each image.")
@click.option("--force", is_flag=True, help="Write over detections that are there already.")
def detect(session: Path, colour: Colour, debug_images: Path | None, force: bool) -> None:
    """Find LEDs and targets in SESSION/images/<camera>/<pose>.png, or <camera>.mp4, and write detections.csv.

    With several LEDs, or with targets, an LED's images are called <pose>.<led>.png; <pose>.off.png, with the LEDs
    dark, is subtracted. What was rejected, and why, is in detections_rejected.csv.
    """
    find_leds(session, colour, debug_images, force=force)


def find_leds(session: Path, colour: Colour = "any", debug_images: Path | None = None, *, force: bool = False) -> None:
    """Find LEDs and targets in a session's images, write the tables and print what came of it."""
    from urdfcal.detection.detect import detect_in, open_images, write_debug_images, write_detected

    positions, index = open_images(session)
    with progress_bar("reading images", index.count) as advance:
        detected = detect_in(positions, index, colour, advance)
    if debug_images is not None:
        with progress_bar("drawing", index.count) as advance:
            write_debug_images(debug_images, detected, colour, advance)
    paths = write_detected(session, detected, force=force)
    sigma = detected.detections.sigma
    say(
        f"{detected.found} detections in {index.count} images, "
        f"found to {sorted(sigma)[len(sigma) // 2]:.3f} px each (median)"
    )
    if rejected := detected.summary():
        say(f"besides these, rejected: {rejected}")
    for warning in detected.warnings:
        say(f"- {warning}")
    for path in paths:
        click.echo(str(path))


@click.command("calibrate")
@click.argument("sessions", type=PATH, nargs=-1, required=True, metavar="SESSION...")
@click.option("-o", "--output", type=PATH, required=True, help="Folder of the results.")
@seed_option
@click.option(
    "--method", type=click.Choice(["pixels", "points"]), default="pixels",
    help="What the estimate rests on: pixels, or points triangulated from them.",
)  # fmt: skip
@click.option("--no-priors", is_flag=True, help="Plain least squares, without manufacturing tolerances.")
@click.option(
    "--starts", type=click.IntRange(min=0), default=0, show_default=False, metavar="N",
    help="Start from N other arms, too, and screen the minima.",
)  # fmt: skip
@click.option(
    "--exclude-poses", metavar="POSES",
    help="Leave these poses out: labels and ranges, such as 26-31,40; of several sessions SESSION/26-31.",
)  # fmt: skip
@click.option("--ignore-limits", is_flag=True, help="Take joint readings beyond the URDF's limits as they are.")
@click.option("--force", is_flag=True, help="Write the result even if its assessment has failures.")
@click.option(
    "--figures", type=click.Choice(_FIGURES), callback=_drawable,
    help="Write the report's figures as files, too, into OUT/figures.",
)  # fmt: skip
@click.option("--live", is_flag=True, help="Show the solver at work in the rerun viewer.")
@click.option("--json", "as_json", is_flag=True, help="Print calibration.json and the files instead of a summary.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def command(
    sessions: tuple[Path, ...], output: Path, no_priors: bool, exclude_poses: str | None, ignore_limits: bool,
    figures: str | None, live: bool, as_json: bool, quiet: bool, **how: Any,
) -> None:  # fmt: skip
    """Calibrate the robot of SESSION and write URDF, calibration.json, report and recording.

    Several sessions of one arm are calibrated together: in each it may stand elsewhere, before other cameras, with
    other LEDs.
    """
    from urdfcal.io.folder import read_sessions

    report: Report = "nothing" if quiet else "json" if as_json else "text"

    def look(session: Path) -> None:
        with redirect_stdout({"text": sys.stdout, "json": sys.stderr, "nothing": io.StringIO()}[report]):
            say(f"{session}: images and no detections: looking for the LEDs first (urdfcal detect)")
            find_leds(session)

    poses = exclude_poses.split(",") if exclude_poses else []
    labels = [label.strip() for label in poses if label.strip()]
    measured = read_sessions(sessions, look, exclude_poses=labels, ignore_limits=ignore_limits)
    run(measured, output, figures=figures, live=live, report=report, priors=not no_priors, **how)


def run(
    session: Session,
    output: Path,
    *,
    figures: str | None = None,
    live: bool = False,
    report: Report = "text",
    force: bool = False,
    **how: Any,
) -> FittedCalibration:
    """Calibrate a session as :func:`urdfcal.pipeline.calibrate` does, write its results and print the summary.

    Of a result that is refused only the report is written, where it replaces nothing.
    """
    from urdfcal.output.findings import Overview
    from urdfcal.pipeline import calibrate, refusal

    view = None
    if live:
        from urdfcal.output.live import LiveView

        view = LiveView()
    # Printed when the spinner is gone, whose line they would share.
    why: list[str] = []
    try:
        with status_line(show=report != "nothing") as status:
            steps = 0

            def note(iteration: int, cost: float) -> None:
                nonlocal steps
                steps += 1
                status(f"calibrating: step {steps}, cost {cost:.4g}")
                if view is not None:
                    view.step(iteration, cost)

            why += session.warnings  # what looked odd in it is often why it fails
            calibration = calibrate(session, **how, force=True, progress=note)
            why[:] = calibration.warnings  # so is what was found in the residuals
            if calibration.failures and not force:
                status("writing the report")
                report_path, trouble = _refused(calibration, output)
                why += trouble
                raise refusal(calibration, report_path)
            status("writing URDF, report and recording")
            if view is not None:
                view.say("writing URDF, report and recording")
            from urdfcal.output.recording import write_results

            overview = Overview.of(calibration)
            paths, remarks = write_results(calibration, output, overview, figures=figures)
            if view is not None and not view.finish(overview):
                remarks = (*remarks, f"the rerun viewer was closed: urdfcal view {output} shows the result")
    except CalibrationError:
        for text in why:
            say(f"- {text}", err=True)
        raise
    if report == "json":
        files = {path.suffix[1:]: str(path) for path in paths}
        click.echo(json.dumps({**overview.document, "files": files}, indent=2))
    elif report == "text":
        print_summary(overview, paths, remarks)
    return calibration


def _refused(calibration: FittedCalibration, output: Path) -> tuple[Path | None, tuple[str, ...]]:
    """Report a calibration that is refused; None where that is not possible either, and perhaps why."""
    from urdfcal.output.recording import write_refused

    try:
        return write_refused(calibration, output), ()
    except OutputError as error:
        return None, (str(error),)
    except CalibrationError:  # not even its errors are numbers
        return None, ()
