"""``urdfcal detect``: the LEDs in a session's images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from urdfcal.cli.console import PATH, progress_bar

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.images.files import Colour

# As in urdfcal.images.files, which takes long to import.
_COLOURS = ("any", "red", "green", "blue")


@click.command("detect")
@click.argument("session", type=PATH)
@click.option("--colour", type=click.Choice(_COLOURS), default="any", help="Of the LED, in colour images.")
@click.option("--debug-images", type=PATH, help="Folder for drawings of what was found in each image.")
def command(session: Path, colour: Colour, debug_images: Path | None) -> None:
    """Find the LEDs in SESSION/images/<camera>/<pose>.png, or <camera>.mp4, and write detections.csv.

    With several LEDs the images are called <pose>.<led>.png; <pose>.off.png, with the LEDs dark, is subtracted.
    What was rejected, and why, is in detections_rejected.csv.
    """
    run(session, colour, debug_images)


def run(session: Path, colour: Colour = "any", debug_images: Path | None = None) -> None:
    """Find the LEDs in a session's images, write the tables and print what came of it."""
    from urdfcal.detection.detect import detect_in, open_images, write_debug_images, write_detected

    positions, index = open_images(session)
    with progress_bar("reading images", index.count) as advance:
        detected = detect_in(positions, index, colour, advance)
    if debug_images is not None:
        with progress_bar("drawing", index.count) as advance:
            write_debug_images(debug_images, detected, colour, advance)
    paths = write_detected(session, detected)
    sigma = detected.detections.sigma
    click.echo(
        f"{detected.found} detections in {index.count} images, "
        f"found to {sorted(sigma)[len(sigma) // 2]:.3f} px each (median)"
    )
    if rejected := detected.summary():
        click.echo(f"rejected: {rejected}")
    for warning in detected.warnings:
        click.echo(f"- {warning}")
    for path in paths:
        click.echo(str(path))
