"""``urdfcal plan``: the poses to measure next."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from urdfcal.cli.console import PATH, json_option, progress_bar, say, seed_option, sheet, terminal

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.planning.planner import Plan
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.model import Setup

# Poses that are enough for any arm: what more bring is below a tenth.
_MOST = 100
_DEFAULT = 10
# After so many poses, every so many are in the table: --json has them all.
_SHOWN = 10
_METRES = {"um": 1e-6, "mm": 1e-3, "m": 1.0}


class Length(click.ParamType[float]):
    """A length with its unit, as 0.2mm."""

    name = "length"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return it in metres."""
        if isinstance(value, float):
            return value
        found = re.fullmatch(r"(\d*\.?\d+) ?(um|mm|m)", str(value))
        if found is None or float(found[1]) == 0.0:
            self.fail(f"{value!r} is no length: write it with its unit, as 0.2mm", param, ctx)
        return float(found[1]) * _METRES[found[2]]


@click.command("plan")
@click.argument("start", metavar="SESSION|RESULT|RIG")
@click.option("-o", "--output", type=PATH, required=True, help="Table to write, as joints.csv.")
@click.option(
    "--poses", type=click.IntRange(min=1), show_default=False,
    help=f"How many; with --until at most.  [default: {_DEFAULT}; with --until {_MOST}]",
)  # fmt: skip
@click.option(
    "--until", type=Length(), metavar="LENGTH",
    help="As few as bring the tip's rms error to this in nine of ten arms, such as 0.2mm.",
)  # fmt: skip
@click.option(
    "--workspace", metavar="BOX|FILE|session", show_default=False,
    help="Where the tip is to be accurate: x0:x1,y0:y1,z0:z1 in the base link's frame in m, a CSV file of joint "
    "values, or the session's poses.  [default: the joints' ranges]",
)  # fmt: skip
@click.option("--candidates", type=click.IntRange(min=1), default=2000, help="Poses to choose from.")
@click.option(
    "--scene", type=PATH, metavar="FILE",
    help="Boxes that stand around the arm, as under the key scene of rig.yaml: {scene: {wall: {size: [x, y, z], "
    "position: [x, y, z], rpy: [r, p, y]}}}, in the base link's frame, in m and rad.",
)  # fmt: skip
@click.option("--no-check", is_flag=True, help="Plan no further random poses to check the calibration by.")
@click.option(
    "--format", "also", multiple=True, type=click.Choice(["urscript", "ros", "lerobot"]),
    help="Write what drives an arm through them, too, beside the table.",
)  # fmt: skip
@click.option(
    "--save", type=PATH, metavar="FILE",
    help="Write a recording, too: the arm in each pose, what it brings, the tip's error before and after.",
)  # fmt: skip
@seed_option
@json_option
def command(
    start: str, output: Path, poses: int | None, until: float | None, workspace: str | None, candidates: int,
    scene: Path | None, no_check: bool, also: tuple[str, ...], save: Path | None, seed: int, as_json: bool,
) -> int:  # fmt: skip
    """Plan the poses to measure next, those that make the tip most accurate.

    From a SESSION with a few measured poses; before anything is measured from a RIG (a shipped rig's name or a
    folder), or for an arm that was calibrated before from its RESULT, if the cameras still stand where they stood.
    In every pose the arm keeps clear of itself, the table, the cameras and what is named, and every camera sees every
    LED; moves from row to row, straight in joint space, are free as well. Rows named pass1, pass2, ... only lead around
    something.
    Watch the first run: what stands around the arm and is not named in --scene is not known here.

    Rows named check1, check2, ... are random poses, a fifth more and at least four, to check the result by. Measure
    them with the others and calibrate with --exclude-poses check1,check2,...: it says how far the arm is off in them.
    Where a SESSION has such rows and numbers already, these names go on: check5, ...

    Exit status 1 says that --until cannot be reached.
    """
    from urdfcal.files import written
    from urdfcal.io.scene import read_scene
    from urdfcal.planning.files import FORMATS, WRITERS, as_csv
    from urdfcal.planning.planner import Planner
    from urdfcal.planning.workspace import parse_workspace
    from urdfcal.result.calibration import Calibration
    from urdfcal.session.model import Session

    others = {output.with_suffix(WRITERS[of][0]): WRITERS[of][1] for of in FORMATS if of in also}
    _distinct(output, *others, *([] if save is None else [save]))
    setup, where, boxes = _read(start), parse_workspace(workspace), () if scene is None else read_scene(scene)
    count, measured = poses or (_DEFAULT if until is None else _MOST), isinstance(setup, Session | Calibration)
    with progress_bar("planning", candidates + 3 * count) as advance:
        urdf = _urdf_of(start, setup) if isinstance(setup, Calibration) else None
        planner = Planner(
            setup, urdf=urdf, scene=boxes, workspace=where, candidates=candidates, seed=seed, progress=advance
        )
        found = planner.plan(count, until=until or 0.0, check=not no_check, progress=advance)
    files = {}
    if found.count:
        files = {output: as_csv(found), **{path: text_of(found) for path, text_of in others.items()}}
    with written(files):
        if save is not None:
            found, files = _recorded(save, found), {**files, **({save: ""} if files else {})}
    for warning in found.warnings:
        say(f"- {warning}", err=True)
    if as_json:
        click.echo(json.dumps(_as_dict(found), indent=2))
    else:
        _print(found, [str(path) for path in files], until, "" if measured else ", as far as tolerances let it be off,")
        if isinstance(setup, Calibration):
            sentence, lines = _how_to_go_on(setup)
            say(sentence)
            click.echo(lines)
    return int(until is not None and found.likely[-1] > until)


def _distinct(*paths: Path) -> None:
    """Refuse to write two things into one file."""
    from urdfcal.errors import OutputError

    for k, path in enumerate(paths):
        if path.resolve() in (other.resolve() for other in paths[:k]):
            remedy = "Give -o plan.csv, and --save another name."
            raise OutputError("two files of this plan would be one", where=str(path), remedy=remedy)


def _recorded(path: Path, plan: Plan) -> Plan:
    """Write the recording of a plan, if it has poses, and return it with what is to be said of that."""
    from urdfcal.output.plan_recording import write_plan

    said = write_plan(path, plan) if plan.count else (f"there is nothing to record: {path} is not written",)
    return replace(plan, warnings=(*plan.warnings, *said))


def _read(start: str) -> Setup | Calibration:
    """Read a session, a result, or a rig."""
    from pathlib import Path

    from urdfcal.io.folder import read_rig, read_session
    from urdfcal.io.shipped_rigs import find_rig
    from urdfcal.result.calibration import FILE_NAME, Calibration

    path = Path(start)
    if (path / "session.yaml").is_file() or path.name == "session.yaml":
        return read_session(path)
    if (path / FILE_NAME).is_file() or path.name == FILE_NAME:
        return Calibration.load(path)
    return read_rig(find_rig(start))


def _urdf_of(start: str, calibration: Calibration) -> Urdf | None:
    """Read the corrected URDF beside a result, if it is still there."""
    from pathlib import Path

    from urdfcal.result.calibration import corrected_name
    from urdfcal.robot.urdf.urdf import Urdf

    path = Path(start)
    beside = (path if path.is_dir() else path.parent) / corrected_name(calibration.document.robot.urdf)
    return Urdf.read(beside) if beside.is_file() else None


def _how_to_go_on(calibration: Calibration) -> tuple[str, str]:
    """Say what makes few poses enough: that the arm is known, but for the joints' zeros; and lines of YAML to copy."""
    from urdfcal.planning.recalibration import tolerances_of
    from urdfcal.result.calibration import corrected_name

    known, urdf = tolerances_of(calibration.document), corrected_name(calibration.document.robot.urdf)
    sentence = (
        "planned for the arm as it was calibrated, its joints' zeros as unknown as after a repair; calibrate from the "
        "corrected URDF and say how well it is known, in the new poses' session.yaml:"
    )
    tolerances = f"{{length: {known.length:.2g}, angle: {known.angle:.2g}}}"
    return sentence, f"  robot: {{urdf: {urdf}, ...}}\n  tolerances: {tolerances}"


def _print(plan: Plan, paths: list[str], until: float | None, before: str) -> None:
    now, then = (f"{1e3 * error:.3g} mm" for error in (plan.errors[0], plan.errors[-1]))
    if not plan.count:
        say(f"nothing more to measure: the tip's rms error is expected at {now}, as it is")
        return
    rows = sheet("", ["poses", "tip, expected (mm rms)", "in 9 of 10 arms at most"], texts=0)
    for k, (error, likely) in enumerate(zip(plan.errors, plan.likely, strict=True)):
        if _SHOWN < k < plan.count and k % _SHOWN:
            continue
        rows.add_row(str(k), f"{1e3 * error:.3g}", f"{1e3 * likely:.3g}")
    terminal().print(rows)
    passed = int((~plan.measured).sum())
    say(
        f"{', '.join(paths)}: {plan.count} poses" + (f", and {passed} to pass through" if passed else "") + "; "
        f"the tip's expected rms error goes from {now}{before} to {then}"
    )
    if checks := _checks(plan):
        say(f"and {len(checks)} random ones to check by: calibrate with --exclude-poses")
        click.echo(f"  {','.join(checks)}")
    if until is not None and plan.likely[-1] > until:
        why = "no poses would" if plan.floor > until else "a better camera, a nearer one or more LEDs would help more"
        reached = f"9 of 10 arms come to {1e3 * plan.likely[-1]:.4g} mm at most"
        say(f"{1e3 * until:.3g} mm is not reached: {reached}; {why}")


def _checks(plan: Plan) -> list[str]:
    """Return the labels of the poses to check by."""
    from urdfcal.planning.files import labels

    return [label for label, check in zip(labels(plan), plan.check.tolist(), strict=True) if check]


def _as_dict(plan: Plan) -> dict[str, object]:
    return {
        "poses": plan.count,
        "check_poses": _checks(plan),
        "tip_mm": [1e3 * error for error in plan.errors.tolist()],
        "tip_at_most_mm": [1e3 * error for error in plan.likely.tolist()],
        "warnings": list(plan.warnings),
    }
