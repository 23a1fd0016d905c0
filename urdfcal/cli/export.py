"""``urdfcal export``: a result in the formats of motion stacks and controllers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from urdfcal import files
from urdfcal.cli.console import PATH, result_argument, say

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from urdfcal.result.calibration import Calibration

_FORMATS = (
    "urdf",
    "ros-kinematics",
    "ros-static-tf",
    "mjcf",
    "offsets",
    "dh-csv",
    "xacro-patch",
    "franka-kinematics",
    "lerobot",
)


@click.command("export")
@result_argument
@click.option("--to", "target", type=click.Choice(_FORMATS), required=True, help="What to write.")
@click.option(
    "-o", "--output", type=PATH,
    help="Folder to write to.  [default: that of OUT; for mjcf that of the model, where its meshes are]",
)  # fmt: skip
@click.option("--link-keys", is_flag=True, help="ros-kinematics: name origins by links, as ur_description does.")
@click.option("--add-frames", is_flag=True, help="ros-static-tf: fixed joints in the URDF instead of a launch file.")
@click.option("--model", type=PATH, help="mjcf: a MuJoCo file of the nominal robot.")
@click.option("--servos", is_flag=True, help="mjcf: position servos yield to gravity as the joints were found to.")
@click.option("--motors", type=PATH, help="lerobot: its calibration when the joints were read.")
@click.option(
    "--workspace", metavar="BOX|PATH.csv|SESSION",
    help="urdf: where the arm is used; a box is x0:x1,y0:y1,z0:z1 in m.  [default: what was measured]",
)  # fmt: skip
def command(
    result: Path, target: str, output: Path | None, link_keys: bool, add_frames: bool, model: Path | None,
    servos: bool, motors: Path | None, workspace: str | None,
) -> None:  # fmt: skip
    """Write the result in OUT, a folder that calibrate has written, for ROS, MuJoCo, xacro or a controller.

    urdf: of an arm that bends, the rigid one that is nearest to it in a workspace; what it loses is printed.
    ros-kinematics: origins as ur_description's default_kinematics.yaml has them. ros-static-tf: the poses of cameras
    and LEDs. mjcf: a MuJoCo model of the robot with the calibrated placements. offsets: the joints' zero offsets to
    enter in a controller or in ros2_control's description, and the URDF without them. dh-csv: the calibrated DH
    rows. xacro-patch: a table of origins for a xacro file. franka-kinematics: origins as franka_description's
    kinematics.yaml has them (xArm's are ros-kinematics). lerobot: a motor calibration with the zero offsets of an
    SO-100 or SO-101, for use_degrees.
    """
    for given, option, needed in (
        (link_keys, "--link-keys", "ros-kinematics"),
        (add_frames, "--add-frames", "ros-static-tf"),
        (model is not None, "--model", "mjcf"),
        (servos, "--servos", "mjcf"),
        (workspace is not None, "--workspace", "urdf"),
        (motors is not None, "--motors", "lerobot"),
    ):
        if given and target != needed:
            raise click.UsageError(f"{option} goes with --to {needed}")
    if target == "mjcf" and model is None:
        raise click.UsageError("--to mjcf needs --model FILE, a MuJoCo file of the robot")
    if target == "lerobot" and motors is None:
        raise click.UsageError("--to lerobot needs --motors FILE, LeRobot's calibration when the joints were read")
    from urdfcal.result.calibration import Calibration

    beside, calibration = result if result.is_dir() else result.parent, Calibration.load(result)
    written: Mapping[str, str | bytes]
    remark = rigid_part(calibration)
    if target == "urdf":
        written, remark = _region(calibration, beside, workspace)
    elif motors is not None:
        from urdfcal.output.exports.vendors import lerobot_calibration

        written = lerobot_calibration(calibration, motors)
    else:
        written = _files(calibration, beside, target, link_keys=link_keys, add_frames=add_frames, model=model)
    if servos and model is not None:
        from urdfcal.output.exports.servos import yielding_servos

        ((name, data),) = written.items()
        data, stiffness = yielding_servos(calibration, data if isinstance(data, bytes) else data.encode(), model)
        written = {name: data}
        joint, least = min(stiffness.items(), key=lambda item: item[1])
        remark = (
            f"- servos of {len(stiffness)} joints yield to gravity as they do, {joint} the most ({least:.2g} N m "
            "a radian, or N a metre): a control is what the encoder reads, qpos where the joint is"
        )
        if other := rigid_part(calibration, but="compliance"):
            remark += f"\n{other}"
    folder = output or (beside if model is None else model.parent)
    with files.staged(folder) as stage:
        for name, content in written.items():
            files.write_bytes(stage / name, content if isinstance(content, bytes) else content.encode())
    for name in written:
        click.echo(folder / name)
    if remark:
        say(remark)


def rigid_part(calibration: Calibration, but: str = "") -> str:
    """Say that what is written of an arm that bends is its rigid part; nothing of one that does not.

    Args:
        calibration: the result.
        but: the joint model that it can hold.
    """
    models = dict.fromkeys(name for of in calibration.document.joint_models.values() for name in of if name != but)
    if not models:
        return ""
    return f"- it is the rigid part: no such file can hold {', '.join(models)}; compensate and the library do"


def _region(calibration: Calibration, beside: Path, workspace: str | None) -> tuple[Mapping[str, str | bytes], str]:
    """The URDF of the best rigid arm for a workspace, and what it loses."""
    from urdfcal.cli.workspace import configurations
    from urdfcal.output.exports import tables
    from urdfcal.result.rigid import best_rigid

    urdf = tables.corrected_urdf(calibration, beside)
    there = configurations(calibration, workspace)
    fit = best_rigid(calibration, there.q, there.torques, there.previous, there.bends)
    remark = (
        f"- against the full model, on the same base, in {fit.configurations} configurations of {there.what} its tip "
        f"is {1e3 * fit.rms:.2g} mm rms off, {1e3 * fit.most:.2g} mm at most, and {1e3 * fit.angle:.2g} mrad rms; "
        f"the corrected URDF's {1e3 * fit.rms_before:.2g} mm rms"
    )
    if not calibration.joint_models.found:
        remark = "- this arm is rigid: it is the corrected URDF, and nothing is lost"
    return tables.region_urdf(calibration, urdf, fit.placements), remark


def _files(
    calibration: Calibration, beside: Path, target: str, *, link_keys: bool, add_frames: bool, model: Path | None
) -> Mapping[str, str | bytes]:
    from urdfcal.output.exports import frames, mjcf, tables, vendors

    if target == "ros-static-tf" and not add_frames:
        return frames.static_transforms(frames.found_frames(calibration))
    if target == "dh-csv":
        return tables.dh_csv(calibration)
    if target == "xacro-patch":
        return tables.xacro_patch(calibration)
    if target == "ros-kinematics" and not link_keys:
        return tables.ros_kinematics(calibration, tables.joint_keys(calibration))
    urdf = tables.corrected_urdf(calibration, beside)
    if target == "franka-kinematics":
        return vendors.franka_kinematics(calibration, urdf)
    if target == "ros-kinematics":
        return tables.ros_kinematics(calibration, tables.link_keys(calibration, urdf))
    if target == "ros-static-tf":
        return frames.urdf_with_frames(urdf, frames.found_frames(calibration))
    return tables.joint_offsets(calibration, urdf) if model is None else mjcf.mjcf(calibration, urdf, model)
