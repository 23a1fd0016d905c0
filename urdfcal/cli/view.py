"""``urdfcal view``: open the recording of a result."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("view")
@click.argument("output", type=click.Path(path_type=Path), metavar="OUT")
def command(output: Path) -> None:
    """Open the recording in OUT, a folder that calibrate has written, in the rerun viewer."""
    from urdfcal.output.viewer import open_recording

    open_recording(output)
