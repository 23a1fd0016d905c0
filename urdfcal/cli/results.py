"""``urdfcal apply``, ``compensate``, ``export`` and ``view``: what a result is for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from urdfcal import files
from urdfcal.cli.console import PATH, progress_bar, result_argument
from urdfcal.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.output.trajectory import CommandTable
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.compensation import Compensation

_FORMATS = (
    "ros-kinematics",
    "ros-static-tf",
    "mjcf",
    "offsets",
    "dh-csv",
    "xacro-patch",
    "franka-kinematics",
    "lerobot",
)
_BLOCK = 4096  # poses between two steps of the progress bar


@click.command("apply")
@result_argument
@click.argument("urdf", metavar="OTHER.urdf")
@click.option("-o", "--output", type=PATH, help="URDF to write.  [default: OTHER_calibrated.urdf beside it]")
def apply(result: Path, urdf: str, output: Path | None) -> None:
    """Write the calibrated origins into OTHER.urdf, a nominal description of the same robot.

    OUT is a folder that calibrate has written, or its calibration.json. A joint whose nominal origin is not the one
    that was calibrated is refused by name.
    """
    from urdfcal.result.calibration import Calibration, corrected_name
    from urdfcal.robot.urdf.urdf import Urdf

    if output is None:
        if urdf.startswith("package://"):
            raise click.UsageError("a package's URDF needs -o FILE: nothing is written into packages")
        output = Path(urdf).with_name(corrected_name(urdf))
    calibration = Calibration.load(result)
    files.write_bytes(output, calibration.apply_to_urdf(Urdf.read(urdf)))
    click.echo(output)
    if models := dict.fromkeys(name for of in calibration.document.joint_models.values() for name in of):
        click.echo(f"- it is the rigid part: a URDF cannot hold {', '.join(models)}; compensate and the library do")


@click.command("compensate")
@result_argument
@click.argument("trajectory", type=PATH, metavar="TRAJECTORY.csv")
@click.option("-o", "--output", type=PATH, required=True, help="CSV file to write.")
@click.option(
    "--torques",
    type=PATH,
    metavar="FILE.csv",
    help="Joint torques of the same rows, for a compliance under measured ones.",
)
def compensate(result: Path, trajectory: Path, output: Path, torques: Path | None) -> None:
    """Correct the joint commands of TRAJECTORY.csv so that the real tip goes where the nominal one would.

    For a tree of joints this is the session's tip link; the errors of the other tip links are reported.

    OUT is a folder that calibrate has written, or its calibration.json. Columns are joint names, in rad and m; others,
    such as time, are kept. Rows follow each other: an arm with backlash comes from the row before. Poses outside the
    measured domain are counted, with the joints that leave it.
    """
    import numpy as np

    from urdfcal.cli.judging import domain_of
    from urdfcal.output.trajectory import CommandTable
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.compensation import Compensation

    calibration = Calibration.load(result)
    given = CommandTable.read(trajectory, calibration.chain)
    if output.exists() and output.samefile(trajectory):
        remedy = "Name another file: nothing is corrected twice."
        raise OutputError("this is the trajectory itself", where=str(output), remedy=remedy)
    under: dict[str, Any] = {"previous": np.concatenate([given.q[:1], given.q[:-1]])}
    if torques is not None:
        under["torques"] = given.beside(torques, calibration.chain)
    parts = []
    with progress_bar("compensating", len(given.q)) as advance:
        for first in range(0, len(given.q), _BLOCK):
            rows = slice(first, first + _BLOCK)
            parts.append(calibration.compensate(given.q[rows], **{name: of[rows] for name, of in under.items()}))
            advance(len(parts[-1].q))
    found = Compensation(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("q", "position", "angle")))
    files.write_text(output, given.with_commands(found.q))
    before, after = (_errors(calibration, given.q, commands, under) for commands in (given.q, found.q))
    _print_errors(output, given, found, next(iter(before.values())))
    for remark in domain_of(calibration, calibration.chain, given.q).remarks:
        click.echo(remark)
    for link in list(before)[1:]:
        click.echo(
            f"{link} is not compensated: {1e3 * before[link]:.3g} mm rms with the nominal commands, "
            f"{1e3 * after[link]:.3g} mm with the corrected ones"
        )


def _errors(
    calibration: Calibration, nominal_commands: Floats, commands: Floats, under: Mapping[str, Any]
) -> dict[str, float]:
    """Distances (rms, m) of the calibrated tip links with commands (N, k) from the nominal ones with theirs (N, k).

    ``under`` is what joint models depend on beside the commands.
    """
    from urdfcal.robot.kinematics import link_poses
    from urdfcal.robot.mechanism import BASE

    chain = calibration.chain
    tips = [chain.tips[0], *(tip for tip in chain.tips[1:] if tip.joint != BASE)]
    nominal = link_poses(chain, chain.joint_values(nominal_commands), tips)
    real = link_poses(calibration.calibrated, calibration.joint_values(commands, **under), tips)
    return {tip.link: _rms_length(T[:, :3, 3] - S[:, :3, 3]) for tip, T, S in zip(tips, real, nominal, strict=True)}


def _print_errors(path: Path, given: CommandTable, found: Compensation, before: float) -> None:
    """Print the error that the commands leave, and the lines of the worst poses: singular, at a limit, out of reach."""
    worst, most_turned = int(found.position.argmax()), int(found.angle.argmax())
    click.echo(
        f"{path}: {len(given.q)} poses\n"
        f"distance of the calibrated tip from the nominal one: {1e3 * before:.3g} mm rms with the nominal commands, "
        f"{1e3 * _rms_length(found.position[:, None]):.3g} mm with the corrected ones\n"
        f"worst residual: {1e3 * found.position[worst]:.3g} mm (line {given.line(worst)}), "
        f"{1e3 * found.angle[most_turned]:.3g} mrad (line {given.line(most_turned)})"
    )


def _rms_length(vectors: Floats) -> float:
    return float((vectors**2).sum(axis=1).mean() ** 0.5)


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
@click.option("--motors", type=PATH, help="lerobot: its calibration when the joints were read.")
def export(
    result: Path, target: str, output: Path | None, link_keys: bool, add_frames: bool, model: Path | None,
    motors: Path | None,
) -> None:  # fmt: skip
    """Write the result in OUT, a folder that calibrate has written, for ROS, MuJoCo, xacro or a controller.

    ros-kinematics: origins as ur_description's default_kinematics.yaml has them. ros-static-tf: the poses of cameras
    and LEDs. mjcf: a MuJoCo model of the robot with the calibrated placements. offsets: the joints' zero offsets to
    enter in a controller, and the URDF without them. dh-csv: the calibrated DH rows. xacro-patch: a table of origins
    for a xacro file. franka-kinematics: origins as franka_description's kinematics.yaml has them (xArm's are
    ros-kinematics). lerobot: a motor calibration with the zero offsets of an SO-100 or SO-101, for use_degrees.
    """
    for given, option, needed in (
        (link_keys, "--link-keys", "ros-kinematics"),
        (add_frames, "--add-frames", "ros-static-tf"),
        (model is not None, "--model", "mjcf"),
        (motors is not None, "--motors", "lerobot"),
    ):
        if given and target != needed:
            raise click.UsageError(f"{option} goes with --to {needed}")
    if target == "mjcf" and model is None:
        raise click.UsageError("--to mjcf needs --model FILE, a MuJoCo file of the robot")
    if target == "lerobot" and motors is None:
        raise click.UsageError("--to lerobot needs --motors FILE, LeRobot's calibration when the joints were read")
    beside = result if result.is_dir() else result.parent
    if motors is not None:
        from urdfcal.output.exports.vendors import lerobot_calibration
        from urdfcal.result.calibration import Calibration

        written: Mapping[str, str | bytes] = lerobot_calibration(Calibration.load(result), motors)
    else:
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
    from urdfcal.output.exports import frames, mjcf, tables, vendors
    from urdfcal.result.calibration import Calibration

    calibration = Calibration.load(result)
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


@click.command("view")
@result_argument
@click.option("--web", is_flag=True, help="Serve it as a web page, to this machine only.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, show_default=False,
    help="Of the web page.  [default: any free one]",
)  # fmt: skip
@click.option("--overlay", metavar="POSE", help="Draw the arm into the cameras' images of a pose instead: a PNG.")
@click.option("--save", type=PATH, help="Write the recording, or the overlay, to this file.")
def view(result: Path, web: bool, port: int, overlay: str | None, save: Path | None) -> None:
    """Open the recording in OUT, a folder that calibrate has written, in the rerun viewer."""
    from urdfcal.output.viewer import find_recording, open_recording, serve_recording

    recording = find_recording(result)
    if overlay is not None:
        from urdfcal.output.images import write_overlay

        path = save or recording.with_name(f"overlay_{Path(overlay).name}.png")
        write_overlay(path, recording, overlay)
        click.echo(path)
    elif save is not None:
        files.write_bytes(save, recording.read_bytes())
        click.echo(save)
    elif web:
        serve_recording(recording, port)
    else:
        open_recording(recording)
