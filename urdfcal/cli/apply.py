"""``urdfcal apply``: write the calibrated origins into another, or a regenerated, URDF of the same robot."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("apply")
@click.argument("result", type=click.Path(path_type=Path), metavar="OUT")
@click.argument("urdf", metavar="OTHER.urdf")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="URDF to write.  [default: OTHER_calibrated.urdf beside it]"
)
def command(result: Path, urdf: str, output: Path | None) -> None:
    """Write the calibrated origins into OTHER.urdf, a nominal description of the same robot.

    OUT is a folder that calibrate has written, or its calibration.json. A joint whose nominal origin is not the one
    that was calibrated is refused by name.
    """
    from urdfcal import files
    from urdfcal.result.calibration import Calibration, corrected_name
    from urdfcal.robot.urdf.urdf import Urdf, find_urdf

    if output is None:
        if urdf.startswith("package://"):
            raise click.UsageError("a package's URDF needs -o FILE: nothing is written into packages")
        output = Path(urdf).with_name(corrected_name(urdf))
    calibration = Calibration.load(result)
    files.write_bytes(output, calibration.apply_to_urdf(Urdf.read(find_urdf(urdf))))
    click.echo(output)
