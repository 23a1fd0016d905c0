"""``urdfcal evaluate`` and ``dh``: robots compared, a session explained by one, and the rows of one."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from urdfcal.cli.console import PATH, base_option, json_option, say, seed_option, sheet, terminal
from urdfcal.errors import CalibrationError, SessionError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.evaluation import Explanation
    from urdfcal.estimation.solver import Solution
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.dh import Convention, DHTable
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session

# Points this many times farther apart than the arm reaches are in another unit.
_FAR = 20.0
# A ball that was mounted anew by millimetres multiplies the residuals by ten; to hold it that costs less is no sign.
_ELSEWHERE, _CHANCE = 2.0, 1e-4
# As in urdfcal.result.calibration, which takes long to import.
_RESULT = "calibration.json"
_ACROSS = "across_rays_mm"
_FITTED_ANEW = (
    "this is the session that it was calibrated with: another one will be further off; residuals differ a little from "
    "calibrate's, since base, LEDs and camera poses are fitted anew, by themselves"
)


@click.command("evaluate")
@click.argument("urdf", metavar="A.urdf|RESULT")
@click.argument("other", metavar="B.urdf|SESSION")
@click.option("--tip", metavar="LINK", help="Link at the end of the chain.  [default: the session's]")
@base_option
@click.option("--poses", type=click.IntRange(min=4), help="Configurations compared.  [default: 1000]")
@click.option("--points", type=PATH, help="With a session: this points.csv instead of its own measurements.")
@seed_option
@json_option
def evaluate(
    urdf: str,
    other: str,
    tip: str | None,
    base: str | None,
    poses: int | None,
    points: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Compare the tips of two versions of a robot over its workspace, or the residuals of a session under one.

    With a session, base pose, LED positions and what else it does not know (camera poses, places) are fitted; the arm
    is A's, and for comparison the session's own as its URDF and cameras have it (nominal). Of a RESULT, a folder that
    calibrate has written or its calibration.json, arm and LEDs are as calibrated, unless these were fastened anew, and
    lenses that it estimated where they suit better than the session's. Poses outside its measured domain are counted.
    Known distances of places take no part: they are shown beside those that come out. Pixels are given in mm as well,
    at the LED across the ray and without outliers, as calibrate gives held-out poses.
    """
    if turned := _reversed(Path(urdf), Path(other)):
        raise click.UsageError(turned)
    if Path(other).is_dir() or other.endswith((".yaml", ".yml")):
        if tip or base or poses:
            what = "with a session, links and poses are the session's: leave --tip, --base, --poses out"
            raise click.UsageError(what)
        result = _session(urdf, Path(other), points)
    elif not Path(other).exists() and not other.startswith("package://"):
        raise SessionError("there is no such file or folder", where=other, remedy="Name a URDF, or a session's folder.")
    elif points is not None:
        raise click.UsageError("--points goes with a session")
    elif tip is None:
        raise click.UsageError("two URDFs need --tip LINK")
    else:
        result = compared(urdf, other, tip, base, poses or 1000, seed)
    if as_json:
        click.echo(json.dumps(result, indent=2))
    else:
        _print_residuals(result)


def _reversed(arm: Path, other: Path) -> str:
    """What is wrong with the order of evaluate's arguments; empty if nothing is."""
    if _is_session(arm):
        return f"{arm} is a session, which comes second: urdfcal evaluate {other} {arm}"
    if other.name == _RESULT or ((other / _RESULT).exists() and not _is_session(other)):
        return f"{other} is a result, which comes first; second a session, or with --tip the URDF to compare it with"
    return ""


def _is_session(path: Path) -> bool:
    return path.suffix in (".yaml", ".yml") or (path / "session.yaml").exists()


def compared(a: str, b: str, tip: str, base: str | None, poses: int, seed: int) -> dict[str, Any]:
    """How far the tips of two URDFs are apart over the workspace, in mm and mrad."""
    import numpy as np

    from urdfcal.estimation.evaluation import compare
    from urdfcal.robot.chain import Chain

    chain_a, chain_b = (Chain.from_urdf(path, tip, base) for path in (a, b))
    q = chain_a.random_values(poses, np.random.default_rng(seed))
    difference = compare(chain_a, chain_b, q)
    units = {"position": "mm", "orientation": "mrad", "position_unaligned": "mm", "orientation_unaligned": "mrad"}
    spreads = {f"{name}_{unit}": _spread(getattr(difference, name), 1e3) for name, unit in units.items()}
    return {"a": a, "b": b, "poses": poses, "seed": seed, **spreads}


def _session(urdf: str, folder: Path, points: Path | None) -> dict[str, Any]:
    import numpy as np

    from urdfcal.arrays import rms
    from urdfcal.cli.judging import arm_of, calibrated_with, domain_of, is_urdf, lenses_as_calibrated
    from urdfcal.estimation.blocks.places import PLACES
    from urdfcal.estimation.evaluation import explain
    from urdfcal.io.folder import read_points, read_session
    from urdfcal.result.calibration import Calibration

    calibration = None if is_urdf(urdf) else Calibration.load(urdf)
    session = read_session(folder, ignore_limits=True)  # beyond them is a warning: nothing is calibrated
    for warning in session.warnings:
        say(f"- {warning}", err=True)
    if points is not None:
        measured, leds = read_points(points, session)
        extent = float(np.ptp(measured.xyz, axis=0).max())
        if extent > _FAR * session.chain.reach:
            what = f"the points are spread over {extent:.0f} m, the arm reaches {session.chain.reach:.1f} m"
            remedy = "Coordinates are in metres; these look like millimetres."
            raise SessionError(what, where=str(points), remedy=remedy)
        session = replace(session, measurements=(measured,), leds=leds, moved={})
    arm = arm_of(urdf, calibration, session, folder)
    try:
        nominal = _sizes(session, explain(session.chain, session))
    except CalibrationError:  # the nominal arm is too far off for these measurements
        nominal = {}
    session, lenses = lenses_as_calibrated(session, arm, calibration)
    explained, elsewhere = _explained(arm, session, calibration)
    result: dict[str, Any] = {"a": urdf, "session": str(folder), "points": points and str(points)}
    for quantity, values in _sizes(session, explained).items():
        drawn = rms(nominal[quantity]) if quantity in nominal else None
        result[quantity] = {"sightings": len(values), **_spread(values, 1.0), "rms_nominal": drawn}
    if named := session.measured_names("place"):
        places = {name: explained.fit.state[PLACES][k].tolist() for k, name in named.items()}
        result["places"] = places
        result["place_distances"] = [
            {
                "places": list(of.places),
                "known_mm": 1e3 * of.distance,
                "found_mm": 1e3 * float(np.linalg.norm(np.subtract(*(places[name] for name in of.places)))),
            }
            for of in session.place_distances
            if places.keys() >= set(of.places)
        ]
    domain = domain_of(calibration, session.chain, session.chain.readings(session.q))
    known = calibration is not None and points is None and calibrated_with(calibration, session)
    outliers, count = explained.fit.counts[0], sum(explained.fit.counts)
    cut = [f"{outliers} of {count} measurements are outliers: mm across rays are without them"]
    for remark in (
        *([_FITTED_ANEW] if known else []),
        *(cut if outliers and _ACROSS in result else []),
        *elsewhere,
        *lenses.remarks,
        *domain.remarks,
    ):
        say(f"- {remark}", err=True)
    return result | lenses.data | domain.data


def _sizes(session: Session, explained: Explanation) -> dict[str, Floats]:
    """Sizes of the residuals, (S,) by what they are of: all of a unit, and each kind where a unit has several."""
    import numpy as np

    found: dict[str, dict[str, Floats]] = {}
    for table, residual in zip(session.measurements, explained.residuals, strict=True):
        for unit, scale, numbers in table.reports():
            found.setdefault(unit, {})[table.kind] = scale * np.linalg.norm(residual[:, numbers], axis=1)
    sizes = {}
    for unit, by_kind in found.items():
        sizes[f"residual_{unit}"] = np.concatenate(list(by_kind.values()))
        if len(by_kind) > 1:
            sizes |= {f"residual_{kind}_{unit}": values for kind, values in by_kind.items()}
    # As verify has it: what was seen where nothing of it was is no error of the arm.
    off = [
        explained.problem.off(of, explained.fit.state)[used]
        for of, used in zip(explained.problem.observations, explained.fit.kept, strict=True)
        if of.table.report[0] == "px"
    ]
    if off:
        sizes[_ACROSS] = 1e3 * np.concatenate(off)
    return sizes


def _explained(arm: Mechanism, session: Session, calibration: Calibration | None) -> tuple[Explanation, list[str]]:
    """Explain a session with its LEDs where a calibration found them, or where they are now; and what is to be said."""
    import numpy as np

    from urdfcal.arrays import rms
    from urdfcal.estimation.blocks.leds import LEDS
    from urdfcal.estimation.evaluation import explain

    fitted = explain(arm, session, bends=None if calibration is None else calibration.joint_models)
    held = session if calibration is None else _leds_as_calibrated(session, calibration)
    if calibration is None or held is session:
        return fitted, []
    explained = explain(arm, held, bends=calibration.joint_models)
    now, then = (rms(np.concatenate([np.ravel(of) for of in each.residuals])) for each in (fitted, explained))
    if then <= _ELSEWHERE * now or not _worse(explained.fit, fitted.fit):
        return explained, []
    places = (each.fit.state[LEDS] for each in (fitted, explained))
    apart = 1e3 * float(np.linalg.norm(np.subtract(*places), axis=1).max())
    what = f"LEDs are up to {apart:.2g} mm from where the calibration found them, which explains {then / now:.2g} times"
    return fitted, [f"{what} the residuals: they are fitted to this session"]


def _worse(held: Solution, free: Solution) -> bool:
    """Whether what is held explains measurements worse than chance has it (F test): few of them fit anything."""
    from scipy.special import fdtrc

    freed = free.parameters.count - held.parameters.count
    left = free.observations + held.parameters.prior_count - free.parameters.count
    if left <= 0:
        return False
    ratio = max(held.cost / free.cost - 1.0, 0.0) * left / freed
    return bool(fdtrc(freed, left, ratio) < _CHANCE)


def _leds_as_calibrated(session: Session, calibration: Calibration) -> Session:
    """Hold LEDs where a calibration found them, if contacts alone are left to tell: they hardly say where a ball is."""
    import numpy as np

    from urdfcal.estimation.measurements import Measurement

    tables = (table for table in session.measurements if isinstance(table, Measurement))
    if any(table.defines_world(session.attachments) for table in tables):
        return session
    known = {(name, led.link): np.array(led.position) for name, led in calibration.document.leds.items()}
    keys = [(led.name, led.link or session.chain.tip_link) for led in session.leds]
    fitted = zip(session.leds, keys, strict=True)
    held = (replace(led, position=known[key], sigma=0.0) if key in known else led for led, key in fitted)
    return replace(session, leds=tuple(held))


def _spread(values: Floats, scale: float) -> dict[str, float]:
    from urdfcal.estimation.evaluation import Spread

    return {name: scale * value for name, value in asdict(Spread.of(values)).items()}


def _print_residuals(result: Mapping[str, Any]) -> None:
    against = result.get("b") or result.get("points") or result["session"]
    columns = {"rms": "rms", "mean": "mean", "median": "median", "p95": "95 %", "max": "max"}
    if "session" in result:
        columns["rms_nominal"] = "nominal rms"
    rows = sheet(f"{result['a']}\nagainst {against}", ["", *columns.values()])
    for name, spread in result.items():
        if name.endswith(("_px", "_mm", "_mrad")):
            quantity, _, unit = name.rpartition("_")
            cells = ["" if spread[key] is None else f"{spread[key]:.4f}" for key in columns]
            rows.add_row(f"{quantity.replace('_', ' ')} ({unit})", *cells)
    terminal().print(rows)
    if "position_unaligned_mm" in result:
        say(
            "bases moved so that the tips agree best over the workspace; unaligned: the base links laid over each other"
        )
    if "calibration" in result.get("lenses", {}).values():
        say("nominal: the session's own arm with its own lenses")
    for known in result.get("place_distances", ()):
        a, b = known["places"]
        say(f"{a} to {b}: {known['found_mm']:.3f} mm, known as {known['known_mm']:.3f} mm")


@click.command("dh")
@click.argument("urdf", metavar="ROBOT.urdf|RESULT")
@click.option("--tip", metavar="LINK", help="Link at the end of the chain; of a RESULT its own.")
@base_option
@click.option(
    "--convention", type=click.Choice(["standard", "modified"]), default="standard",
    help="Distal rows (Rossi's eq. 2), or Craig's.",
)  # fmt: skip
@json_option
def dh(urdf: str, tip: str | None, base: str | None, convention: Convention, as_json: bool) -> None:
    """Print the Denavit-Hartenberg rows of a robot's chain of joints.

    Of a RESULT, a folder that calibrate has written or its calibration.json, they are the nominal rows with the offsets
    that were found; of a corrected URDF they are derived anew, and may jump where axes are almost parallel.
    """
    from urdfcal.cli.judging import is_urdf
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.dh import DHTable

    offsets, what = None, ""
    if not is_urdf(urdf):
        from urdfcal.output.exports.tables import dh_rows
        from urdfcal.result.calibration import Calibration

        if tip or base:
            raise click.UsageError("--tip and --base go with a URDF: a result names its links")
        (table, offsets), what = dh_rows(Calibration.load(urdf)), ", calibrated"
    elif tip is None:
        raise click.UsageError("a URDF needs --tip LINK")
    else:
        table = DHTable.from_chain(Chain.from_urdf(urdf, tip, base))
    data = table.to_dict(convention, offsets)
    if as_json:
        click.echo(json.dumps(data, indent=2))
    else:
        _print_rows(table, data, convention, what)


def _print_rows(table: DHTable, data: Mapping[str, Any], convention: Convention, what: str) -> None:
    import numpy as np

    order = ("theta", "d", "a", "alpha", "beta") if convention == "standard" else ("a", "alpha", "beta", "theta", "d")
    # Micrometres leave joints' names their room at 80 columns.
    scales = {name: (1e3, "mm", 3) if name in "da" else (np.degrees(1.0), "deg", 4) for name in order}
    rows = sheet(
        f"{table.chain.name}: {table.chain.base_link} to {table.chain.tip_link}, {convention} DH{what}",
        ["joint", "type", *(f"{name}\n({unit})" for name, (_, unit, _) in scales.items())],
        texts=2,
    )
    rows.show_edge = False
    for column in rows.columns[2:]:
        column.no_wrap = True  # names continue below, digits are not cut
    for column in rows.columns[:2]:
        column.no_wrap, column.overflow = False, "fold"
    for row in data["rows"]:
        # Rounding first, or tiny negative numbers print as -0.0000.
        cells = [f"{round(scale * row[name], n) + 0.0:.{n}f}" for name, (scale, _, n) in scales.items()]
        rows.add_row(row["joint"], row["type"], *cells)
    console = terminal()
    console.print(rows)
    console.print(data["composition"])
    for name in ("base", "tool"):
        matrix = np.round(data[name], 6) + 0.0
        console.print(f"{name} = {np.array2string(matrix, suppress_small=True, prefix='base = ')}")
