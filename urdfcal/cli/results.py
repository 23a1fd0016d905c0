"""``urdfcal apply``, ``compensate`` and ``view``: what a result is for."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from urdfcal import files
from urdfcal.cli.console import PATH, progress_bar, result_argument, say
from urdfcal.cli.export import rigid_part
from urdfcal.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.found import Carried
    from urdfcal.output.trajectory import CommandTable
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.compensation import Compensation

_PARTS = 3  # of a payload: link, mass, centre; and of its centre
_PAYLOADS = "write tool0:1.2 (kg) or tool0:1.2:0,0,0.05 (m), or nothing"
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
    if remark := rigid_part(calibration):
        say(remark)
    if domain := calibration.document.domain:
        units = {joint.name: joint.unit for joint in calibration.chain.actuated_joints}
        ranges = (f"{name} {low:.2f} to {high:.2f} {units[name]}" for name, (low, high) in domain.joints.items())
        say(f"- it was measured with {', '.join(ranges)}; elsewhere it is extrapolated")


def _payload(ctx: click.Context, param: click.Parameter, text: str | None) -> Carried:
    """A payload, of text."""
    del ctx, param
    if text is None:
        return None
    if text == "nothing":
        return "nothing"
    from urdfcal.arrays import frozen
    from urdfcal.session.knowledge import Payload

    link, *numbers = text.split(":", _PARTS - 1)
    try:
        mass, center = float(numbers[0]), [float(x) for x in numbers[1].split(",")] if numbers[1:] else [0.0] * 3
    except (IndexError, ValueError) as error:
        raise click.BadParameter(f"{text!r} is no payload: {_PAYLOADS}") from error
    if len(center) != _PARTS:
        raise click.BadParameter(f"{text!r} has a centre of {len(center)} numbers, not three: {_PAYLOADS}")
    if mass == 0.0:
        raise click.BadParameter(f"{text!r} weighs nothing: write --payload nothing")
    if not 0.0 < mass < inf:
        raise click.BadParameter(f"{text!r} weighs {mass:g} kg: {_PAYLOADS}")
    return Payload(link, mass, frozen(center))


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
@click.option(
    "--payload",
    callback=_payload,
    metavar="LINK:KG[:X,Y,Z]",
    help="What the arm carries: its link, mass, and its centre in the link's frame in m; or: nothing.  [default: what "
    "it carried when it was calibrated]",
)
def compensate(result: Path, trajectory: Path, output: Path, torques: Path | None, payload: Carried) -> None:
    """Correct the joint commands of TRAJECTORY.csv so that the real tip goes where the nominal one would.

    For a tree of joints this is the session's tip link; the errors of the other tip links are reported.

    OUT is a folder that calibrate has written, or its calibration.json. Columns are joint names, in rad and m; others,
    such as time, are kept. Rows follow each other: an arm with backlash comes from the row before. Poses outside the
    measured domain are counted, with the joints that leave it.
    """
    import numpy as np

    from urdfcal.cli.judging import domain_of
    from urdfcal.estimation.joint_models.under_torque import UnderTorque
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
            here = {name: of[rows] for name, of in under.items()}
            parts.append(calibration.compensate(given.q[rows], **here, payload=payload))
            advance(len(parts[-1].q))
    found = Compensation(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("q", "position", "angle")))
    files.write_text(output, given.with_commands(found.q))
    before, after = (
        _errors(calibration, given.q, commands, {**under, "payload": payload}) for commands in (given.q, found.q)
    )
    _print_errors(output, given, found, next(iter(before.values())))
    for remark in domain_of(calibration, calibration.chain, given.q).remarks:
        say(remark)
    if payload is not None and not any(issubclass(of.kind, UnderTorque) for of in calibration.joint_models.found):
        say("no compliance was estimated of this arm: what it carries makes no difference")
    for link in list(before)[1:]:
        say(
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
    true = calibration.mechanism
    real = link_poses(true, calibration.joint_values(commands, **under), [true.tip(tip.link) for tip in tips])
    return {tip.link: _rms_length(T[:, :3, 3] - S[:, :3, 3]) for tip, T, S in zip(tips, real, nominal, strict=True)}


def _print_errors(path: Path, given: CommandTable, found: Compensation, before: float) -> None:
    """Print the error that the commands leave, and the lines of the worst poses: singular, at a limit, out of reach."""
    worst, most_turned = int(found.position.argmax()), int(found.angle.argmax())
    say(
        f"{path}: {len(given.q)} poses\n"
        f"distance of the calibrated tip from the nominal one: {1e3 * before:.3g} mm rms with the nominal commands, "
        f"{_thousandths(_rms_length(found.position[:, None]))} mm with the corrected ones\n"
        f"worst residual: {_thousandths(found.position[worst])} mm (line {given.line(worst)}), "
        f"{_thousandths(found.angle[most_turned])} mrad (line {given.line(most_turned)})"
    )


def _thousandths(value: float) -> str:
    """In mm or mrad; what is below a nanometre is rounding."""
    return f"{1e3 * value:.3g}" if value > 1e-9 else "less than 1e-6"


def _rms_length(vectors: Floats) -> float:
    return float((vectors**2).sum(axis=1).mean() ** 0.5)


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
    """Open the recording in OUT, a folder that calibrate has written or its calibration.json, in the rerun viewer.

    The calibrated arm is the full one, with its joint models.
    """
    from urdfcal.output.viewer import find_recording, open_recording, serve_recording

    recording = find_recording(result)
    if overlay is not None:
        from urdfcal.output.images import write_overlay

        path = save or recording.with_name(f"overlay_{Path(overlay).name}.png")
        without = write_overlay(path, recording, overlay)
        click.echo(path)
        if without:
            say(
                f"- there is no picture of pose {overlay} by {', '.join(without)}: the arm is drawn on dark ground",
                err=True,
            )
    elif save is not None:
        files.write_bytes(save, recording.read_bytes())
        click.echo(save)
    elif web:
        serve_recording(recording, port)
    else:
        open_recording(recording)
