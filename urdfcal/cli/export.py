"""``urdfcal export``: a result in the formats of its consumers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Mapping

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
@click.option("--model", type=click.Path(path_type=Path), help="mjcf: a MuJoCo file of the robot, as drawn.")
def command(
    result: Path, target: str, output: Path | None, link_keys: bool, add_frames: bool, model: Path | None
) -> None:
    """Write the result in OUT, a folder that calibrate has written, for ROS, MuJoCo, xacro or a controller.

    ros-kinematics: the origins as ur_description's default_kinematics.yaml has them. ros-static-tf: where cameras and
    LEDs are. mjcf: a MuJoCo model of the robot with the calibrated placements. offsets: the joints' zero offsets to
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
    from urdfcal.output.exports.source import corrected_urdf
    from urdfcal.result.calibration import Calibration

    calibration = Calibration.load(result)
    if target == "ros-kinematics":
        from urdfcal.output.exports.ros_kinematics import joint_keys, ros_kinematics
        from urdfcal.output.exports.ros_kinematics import link_keys as keys_of_links

        named = link_keys and keys_of_links(calibration, corrected_urdf(calibration, beside))
        return ros_kinematics(calibration, named or joint_keys(calibration))
    if target == "ros-static-tf":
        from urdfcal.output.exports.frames import found_frames
        from urdfcal.output.exports.static_transforms import static_transforms
        from urdfcal.output.exports.urdf_frames import urdf_with_frames

        frames = found_frames(calibration)
        return (
            urdf_with_frames(corrected_urdf(calibration, beside), frames) if add_frames else static_transforms(frames)
        )
    if target == "offsets":
        from urdfcal.output.exports.offsets import joint_offsets

        return joint_offsets(calibration, corrected_urdf(calibration, beside))
    if target == "dh-csv":
        from urdfcal.output.exports.dh_csv import dh_csv

        return dh_csv(calibration)
    if model is not None:
        from urdfcal.output.exports.mjcf import mjcf

        return mjcf(calibration, corrected_urdf(calibration, beside), model)
    from urdfcal.output.exports.xacro_patch import xacro_patch

    return xacro_patch(calibration)
