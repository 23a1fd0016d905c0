"""``urdfcal view``: show a result."""

from __future__ import annotations

import shutil
from pathlib import Path

import click


@click.command("view")
@click.argument("output", type=click.Path(path_type=Path), metavar="OUT")
@click.option("--web", is_flag=True, help="Serve it as a web page, to this machine only.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Of the web page.  [default: any free one]")
@click.option("--overlay", metavar="POSE", help="Draw the arm into the cameras' images of a pose instead: a PNG.")
@click.option("--save", type=click.Path(path_type=Path), help="Write the recording, or the overlay, to this file.")
def command(output: Path, web: bool, port: int, overlay: str | None, save: Path | None) -> None:
    """Open the recording in OUT, a folder that calibrate has written, in the rerun viewer."""
    from urdfcal.files import replacing
    from urdfcal.output.viewer import find_recording, open_recording, serve_recording

    recording = find_recording(output)
    if overlay is not None:
        from urdfcal.output.images import write_overlay

        path = save or recording.with_name(f"overlay_{Path(overlay).name}.png")
        write_overlay(path, recording, overlay)
        click.echo(path)
    elif save is not None:
        with replacing(save) as temporary:
            shutil.copyfile(recording, temporary)
        click.echo(save)
    elif web:
        serve_recording(recording, port)
    else:
        open_recording(recording)
