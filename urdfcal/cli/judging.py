"""``urdfcal verify`` and ``compare``: a calibration judged by new poses, or by a later calibration."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from urdfcal.cli.console import PATH, json_option, say, seed_option, sheet, status_line, terminal
from urdfcal.typography import millimetres

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.acceptance import Acceptance
    from urdfcal.result.calibration import Calibration
    from urdfcal.result.changes import ArmChanges, ParameterChange
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session

_METRES = {"mm": 1e-3, "m": 1.0}
_ENLARGED = 1.05  # an rms that is larger than its residuals' by more, which evaluate shows, is explained
_NAMED = 3  # changes in the verdict, which the table has all, and poses that repeat others


def _length(ctx: click.Context, param: click.Parameter, text: str) -> float:
    """A length in m, of text with a unit."""
    del ctx, param
    found = re.fullmatch(r"\s*([+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?)\s*([a-zA-Zµ]*)\s*", text)
    try:
        value = float(found[1]) if found else None
    except ValueError:
        value = None
    if found is None or value is None:
        raise click.BadParameter(f"{text!r} is no length: write it as 0.3mm or 3e-4m")
    if found[2] not in _METRES:
        wrong = f"in {found[2]}, not in mm or m" if found[2] else "without a unit"
        raise click.BadParameter(f"{text!r} is {wrong}: write it as {found[1]}mm, or in metres as 3e-4m")
    if not 0.0 < value < inf:
        raise click.BadParameter(f"{text!r} is not positive")
    return value * _METRES[found[2]]


@click.command("verify")
@click.argument("result", metavar="RESULT|ROBOT.urdf")
@click.argument("session", type=PATH)
@click.option("--limit", required=True, callback=_length, metavar="0.3mm", help="What the rms error may be at most.")
@click.option("--tip", metavar="LINK", help="With a URDF: link at the end of the chain.  [default: the session's]")
@click.option("--base", metavar="LINK", help="With a URDF: link at its start.  [default: the session's]")
@seed_option
@json_option
@click.pass_context
def verify(
    ctx: click.Context, result: str, session: Path, limit: float, tip: str | None, base: str | None, seed: int,
    as_json: bool,
) -> None:  # fmt: skip
    """Judge a calibration by SESSION, a dozen new poses, and say whether the rms error at the LED is within a limit.

    Base pose and LED positions (and camera poses, for pixels) are fitted; the arm is that of RESULT, a folder that
    calibrate has written, its calibration.json, or a URDF. The measurements' own noise counts as error, and the rms is
    made larger by as much as what is fitted takes out of few poses; calibrate's and evaluate's are not. In pixels, a
    common factor of all lengths is not seen.

    Exit code 0: the 95 % interval is within the limit; 1: it is not, or that cannot be told.
    """
    from urdfcal.estimation.acceptance import accept
    from urdfcal.io.folder import read_session
    from urdfcal.result.calibration import Calibration
    from urdfcal.session.trajectory import Trajectory

    calibration = None if is_urdf(result) else Calibration.load(result)
    if calibration is not None and (tip or base):
        raise click.UsageError("--tip and --base go with a URDF: a result names its links")
    measured = read_session(session)
    chain = arm_of(result, calibration, measured, session, tip, base)
    for warning in measured.warnings:
        say(f"- {warning}", err=True)
    with status_line() as status:
        status("fitting base, LEDs and cameras")
        measured, lenses = lenses_as_calibrated(measured, chain, calibration)
        bends = None if calibration is None else calibration.joint_models
        found = accept(chain, measured, limit, seed, bends=bends)
    new = calibration is None or not calibrated_with(calibration, measured)
    domain = domain_of(calibration, measured.chain, measured.chain.readings(measured.q))
    if as_json:
        shown = {
            "rms_mm": 1e3 * found.rms,
            "interval_mm": [1e3 * end for end in found.interval],
            "configurations": found.configurations,
            "limit_mm": 1e3 * limit,
            "within": found.within,
            "measurements": found.measurements,
            "outliers": found.outliers,
            "enlarged": found.enlarged,
            "repeats": list(found.repeats),
            "new": new,
            **lenses.data,
            **domain.data,
        }
        click.echo(json.dumps(shown, indent=2))
    else:
        say(_verdict(found, moving=isinstance(measured.motion, Trajectory)))
        if not new:
            say("- these are the measurements that it was calibrated with: others will be further off")
        for remark in (*_enlarged(found), *lenses.remarks, *_left_out(found), *_repeated(found), *domain.remarks):
            say(f"- {remark}")
    ctx.exit(0 if found.within else 1)


class Excursions(NamedTuple):
    """Which poses leave the measured domain of a calibration, as data and in words; empty where it is not known."""

    data: dict[str, Any]
    remarks: tuple[str, ...]


def domain_of(calibration: Calibration | None, mechanism: Mechanism, readings: Floats) -> Excursions:
    """Find the readings (N, k) of a mechanism's actuated joints that a calibration has not measured. [rad or m]."""
    from urdfcal.session.domain import beyond, outside

    domain = None if calibration is None else calibration.document.domain
    if domain is None:
        return Excursions({"poses_outside_domain": None, "outside_domain": None}, ())
    found = outside(mechanism, readings, domain.joints)
    count = int(beyond(mechanism, readings, domain.joints).any(axis=1).sum())
    what = f"{count} of {len(readings)} poses lie outside the measured domain: the calibration is extrapolated there"
    data = {"poses_outside_domain": count, "outside_domain": [asdict(joint) for joint in found]}
    return Excursions(data, (what, *map(str, found)) if found else ())


def is_urdf(reference: str) -> bool:
    """Whether a URDF is named, and no result."""
    path = Path(reference)
    return (
        reference.startswith("package://")
        or path.suffix in (".urdf", ".xml")
        or (path.is_file() and path.suffix != ".json")
    )


def arm_of(
    reference: str, calibration: Calibration | None, session: Session, folder: Path,
    tip: str | None = None, base: str | None = None,
) -> Mechanism:  # fmt: skip
    """The session's joints, to its own links, with the placements of a URDF, or of the calibration if there is one."""
    from urdfcal.robot.apply import apply_to_mechanism
    from urdfcal.robot.chain import read_mechanism
    from urdfcal.robot.urdf.urdf import Urdf

    if calibration is None:
        links = [link.link for link in session.chain.tips]
        return read_mechanism(Urdf.read(reference), [tip or links[0], *links[1:]], base or session.chain.base_link)
    where = session.urdf_reference or str(folder)
    return apply_to_mechanism(session.chain, calibration.chain, calibration.placements, where)


class Lenses(NamedTuple):
    """Which lenses judge an arm, as data and in words; empty where a calibration estimated none."""

    data: dict[str, Any]
    remarks: tuple[str, ...]


def lenses_as_calibrated(session: Session, chain: Mechanism, calibration: Calibration | None) -> tuple[Session, Lenses]:
    """Take the lenses that were estimated with an arm for those of the session's cameras that they suit better.

    Args:
        session: what was measured.
        chain: the calibrated arm.
        calibration: of it; a URDF's is None.

    Returns:
        The session, and what is to be said of its lenses.
    """
    import numpy as np

    from urdfcal.estimation.lens_choice import choose_lenses

    if calibration is None:
        return session, Lenses({"lenses": {}}, ())
    entries = calibration.document.cameras
    found = {
        camera.name: replace(camera, intrinsics=np.array(of.intrinsics), distortion=np.array(of.distortion))
        for camera in session.rig.cameras
        if (of := entries.get(camera.name)) is not None
        and of.sigma.intrinsics
        and (of.resolution, of.distortion_model) == (list(camera.resolution), camera.distortion_model)
    }
    choice = choose_lenses(session, chain, found, calibration.joint_models)
    whose = {name: "calibration" if name in choice.found else "session" for name in found}
    found_better = [name for name in found if name in choice.found & choice.told]
    own_better = [name for name in found if name in choice.told - choice.found]
    remarks = []
    if found_better:
        remarks.append(
            f"lenses of {', '.join(found_better)}: as found with the arm, which suit better than the session's"
        )
    if own_better:
        remarks.append(
            f"lenses of {', '.join(own_better)}: the session's, which suit better than those found with the arm"
        )
    return choice.session, Lenses({"lenses": whose}, tuple(remarks))


def calibrated_with(calibration: Calibration, session: Session) -> bool:
    """Whether every table of a session is one that the calibration was made from."""
    made_from = set(calibration.document.provenance.sha256.values())
    tables = [sha256 for name, sha256 in session.sha256.items() if name.endswith(".csv")]
    return bool(tables) and made_from.issuperset(tables)


def _verdict(found: Acceptance, *, moving: bool) -> str:
    low, high = map(millimetres, found.interval)
    limit = f"within {1e3 * found.limit:.3g} mm"
    why = "too many measurements are outliers" if found.too_many_outliers else "more poses are needed"
    told = {True: limit, False: f"not {limit}", None: f"whether it is {limit} cannot be told: {why}"}
    return (
        f"{millimetres(found.rms)} mm rms (95 %: {low} to {high}), noise of measuring included, in "
        f"{found.configurations} {'seconds of an arm that moves' if moving else 'configurations'}: "
        f"{told[found.within]}"
    )


def _enlarged(found: Acceptance) -> Sequence[str]:
    """Why the rms is not the one that evaluate shows."""
    if found.enlarged < _ENLARGED:
        return []
    fitted = "base, LEDs and camera poses were fitted to these few poses, which took a part of their errors away"
    return [f"{fitted}: the rms is {found.enlarged:.2f} times that of the residuals, which evaluate shows across rays"]


def _left_out(found: Acceptance) -> Sequence[str]:
    count = found.measurements + found.outliers
    return [f"{found.outliers} of {count} measurements are outliers, and do not count"] if found.outliers else []


def _repeated(found: Acceptance) -> Sequence[str]:
    """Which poses are no configurations of their own."""
    from urdfcal.session.trajectory import REPEAT

    if not found.repeats:
        return []
    names = ", ".join(found.repeats[:_NAMED]) + (" ..." if len(found.repeats) > _NAMED else "")
    return [
        f"poses that repeat others to {REPEAT:g} rad or m in every joint are no configurations of their own: {names}"
    ]


@click.command("compare")
@click.argument("first", type=PATH, metavar="RESULT_A")
@click.argument("second", type=PATH, metavar="RESULT_B")
@seed_option
@json_option
@click.pass_context
def compare(ctx: click.Context, first: Path, second: Path, seed: int, as_json: bool) -> None:
    """Tell whether the arm changed between two calibrations of it, and which joint.

    Both are folders that calibrate has written, or their calibration.json. Each parameter that both have estimated,
    of joint models (compliance, lag ...) too, is tested by its own standard deviations, at a chance of 1 % for all of
    them together; and the distance of the tips over the workspace by what both calibrations expect of it, at 1 % again.

    Exit code 0: no change beyond chance; 1: the arm changed.
    """
    from urdfcal.result.calibration import Calibration
    from urdfcal.result.changes import find_changes

    a, b = Calibration.load(first), Calibration.load(second)
    changes = find_changes(a, b, seed)
    remarks = [
        f"{path}: {of.assessment.level}: {of.assessment.sentence}"
        for path, of in ((first, a), (second, b))
        if of.assessment.level != "good"
    ]
    if changes.alone:
        remarks.append(
            f"{len(changes.alone)} parameters were estimated in only one of the two and are not compared: what they "
            f"hold in one, others may hold in the other ({_several(changes.alone)})"
        )
    if changes.unseen:
        remarks.append(f"not compared, since not estimated in both: the zero of {', '.join(changes.unseen)}")
    if changes.unfound:
        remarks.append(
            f"found in one of the two alone, and compared with what it would be in the other, which looked for it in "
            f"vain: {_several(changes.unfound)}"
        )
    if changes.rigid:
        remarks.append(
            "the tips' distance is of the rigid parts alone: one arm gives way to measured torques, which nobody knows "
            "at other poses; urdfcal verify judges the first by poses of the second with all of it"
        )
    if changes.unloaded:
        remarks.append("the arms carried different payloads: the tips' distance is of arms that carry nothing")
    if as_json:
        click.echo(json.dumps({**_changes(changes), "seed": seed, "remarks": remarks}, indent=2))
    else:
        say(_sentence(changes))
        if changes.significant:
            terminal().print(_table(changes))
        say(
            f"chi-square {changes.chi2:.0f} of {len(changes.parameters)} parameters; correlations are unknown, so each "
            "one is tested alone, at 1 % for all together (Bonferroni), and the tips' distance, at 1 %"
        )
        for remark in remarks:
            say(f"- {remark}")
    ctx.exit(1 if changes.changed else 0)


def _several(names: Sequence[str]) -> str:
    return ", ".join([*names[:_NAMED], *(["..."] if len(names) > _NAMED else [])])


def _sentence(changes: ArmChanges) -> str:
    tips = f"tips {millimetres(changes.tip.rms)} mm rms apart"
    if not changes.changed:
        least = changes.expected
        seen = "" if least is None else f"; from {millimetres(least)} mm on they are called changed"
        return f"no change beyond chance: {tips}{seen}"
    if not changes.significant:
        most = f"where errors of both calibrations let expect at most {millimetres(changes.expected or 0.0)} mm"
        return f"the arm changed: {tips} {most}, no single parameter beyond chance"
    named = ", ".join(map(str, changes.significant[:_NAMED]))
    more = len(changes.significant) - _NAMED
    joint, moved = next(iter(changes.joints.items()))
    most = f", {joint} moves them most, by {millimetres(moved)} mm" if moved else ""
    return f"the arm changed: {named}{f' and {more} more' if more > 0 else ''}; {tips}{most}"


def _table(changes: ArmChanges) -> object:
    title = "changes beyond chance; tip: what all of the joint's move it by at rest"
    rows = sheet(title, ["parameter", "unit", "first", "change", "sigma", "sigmas", "tip (mm)"], texts=2, fold=True)
    for p in changes.significant:
        values = [f"{1e3 * value:.3f}" for value in (p.offsets[0], p.change, p.sigma)]
        tip = f"{1e3 * changes.joints[p.joint]:.3f}"
        rows.add_row(f"{p.joint}.{p.parameter}", p.thousandth, *values, f"{p.sigmas:.1f}", tip)
    return rows


def _changes(changes: ArmChanges) -> dict[str, Any]:
    return {
        "changed": changes.changed,
        "significant": [_parameter(p) for p in changes.significant],
        "parameters": [_parameter(p) for p in changes.parameters],
        "chi2": changes.chi2,
        "compared": len(changes.parameters),
        "only_in_one": list(changes.alone),
        "unfound_in_one": list(changes.unfound),
        "unseen": list(changes.unseen),
        "tips_mm": {
            link: {name: 1e3 * value for name, value in asdict(of).items()} for link, of in changes.tips.items()
        },
        "expected_mm": None if changes.expected is None else 1e3 * changes.expected,
        "moves_tip_most": next((joint for joint, moved in changes.joints.items() if moved), None),
        "joints_mm": {joint: 1e3 * moved for joint, moved in changes.joints.items()},
    }


def _parameter(p: ParameterChange) -> dict[str, Any]:
    return {**asdict(p), "change": p.change, "sigmas": p.sigmas}
