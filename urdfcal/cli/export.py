"""``urdfcal export``: a result in the formats of its consumers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from urdfcal.robot.urdf.urdf import Urdf

_FORMATS = ("ros-kinematics", "ros-static-tf", "mjcf", "offsets", "dh-csv", "xacro-patch")


@click.command("export")
@click.argument("result", type=click.Path(path_type=Path), metavar="OUT")
@click.option("--to", "target", type=click.Choice(_FORMATS), required=True, help="What to write.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Folder to write to.  [default: that of OUT; for mjcf that of the model, where its meshes are]",
)
@click.option("--link-keys", is_flag=True, help="ros-kinematics: name origins by links, as ur_description does.")
@click.option("--add-frames", is_flag=True, help="ros-static-tf: fixed joints in the URDF instead of a launch file.")
@click.option("--model", type=click.Path(path_type=Path), help="mjcf: a MuJoCo file of the nominal robot.")
def command(
    result: Path, target: str, output: Path | None, link_keys: bool, add_frames: bool, model: Path | None
) -> None:
    """Write the result in OUT, a folder that calibrate has written, for ROS, MuJoCo, xacro or a controller.

    ros-kinematics: origins as ur_description's default_kinematics.yaml has them. ros-static-tf: the poses of cameras
    and LEDs. mjcf: a MuJoCo model of the robot with the calibrated placements. offsets: the joints' zero offsets to
    enter in a controller, and the URDF without them. dh-csv: the calibrated DH rows. xacro-patch: a table of origins
    for a xacro file.
    """
    from urdfcal import files

    for given, option, needed in (
        (link_keys, "--link-keys", "ros-kinematics"),
        (add_frames, "--add-frames", "ros-static-tf"),
        (model is not None, "--model", "mjcf"),
    ):
        if given and target != needed:
            raise click.UsageError(f"{option} goes with --to {needed}")
    if target == "mjcf" and model is None:
        raise click.UsageError("--to mjcf needs --model FILE, a MuJoCo file of the robot")
    beside = result if result.is_dir() else result.parent
    written = _files(result, beside, target, link_keys=link_keys, add_frames=add_frames, model=model)
    folder = output or (beside if model is None else model.parent)
    with files.staged(folder) as stage:
        for name, content in written.items():
            files.write_bytes(stage / name, content if isinstance(content, bytes) else content.encode())
    for name in written:
        click.echo(folder / name)


def _files(
    result: Path, beside: Path, target: str, *, link_keys: bool, add_frames: bool, model: Path | None
) -> Mapping[str, str | bytes]:
    from urdfcal.output.exports import frames, mjcf, tables
    from urdfcal.result.calibration import Calibration

    calibration = Calibration.load(result)

    def urdf() -> Urdf:
        return tables.corrected_urdf(calibration, beside)

    def keys() -> Mapping[str, str]:
        return tables.link_keys(calibration, urdf()) if link_keys else tables.joint_keys(calibration)

    def found() -> Mapping[str, str | bytes]:
        own = frames.found_frames(calibration)
        return frames.urdf_with_frames(urdf(), own) if add_frames else frames.static_transforms(own)

    exports: dict[str, Callable[[], Mapping[str, str | bytes]]] = {
        "ros-kinematics": lambda: tables.ros_kinematics(calibration, keys()),
        "ros-static-tf": found,
        "mjcf": lambda: mjcf.mjcf(calibration, urdf(), model or Path()),
        "offsets": lambda: tables.joint_offsets(calibration, urdf()),
        "dh-csv": lambda: tables.dh_csv(calibration),
        "xacro-patch": lambda: tables.xacro_patch(calibration),
    }
    return exports[target]()
