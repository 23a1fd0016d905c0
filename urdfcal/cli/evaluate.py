"""``urdfcal evaluate``: two robots compared, or a session explained by a robot."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from urdfcal.cli.options import base_option, seed_option
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats


# Points this many times farther apart than the arm reaches are in another unit.
_FAR = 20.0


@click.command("evaluate")
@click.argument("urdf", metavar="A.urdf")
@click.argument("other", metavar="B.urdf|SESSION")
@click.option("--tip", metavar="LINK", help="Link at the end of the chain.  [default: the session's]")
@base_option
@click.option("--poses", type=click.IntRange(min=4), help="Configurations compared.  [default: 1000]")
@click.option(
    "--points", type=click.Path(path_type=Path), help="With a session: this points.csv instead of its own measurements."
)
@seed_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
def command(
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

    With a session, base pose and LED positions (and camera poses, for pixels) are fitted; the arm is A's.
    """
    if Path(other).is_dir() or other.endswith((".yaml", ".yml")):
        if tip or base or poses:
            raise click.UsageError(
                "with a session, links and poses are the session's: leave --tip, --base, --poses out"
            )
        result = _session(urdf, Path(other), points)
    elif not Path(other).exists() and not other.startswith("package://"):
        raise SessionError("there is no such file or folder", where=other, remedy="Name a URDF, or a session's folder.")
    elif points is not None:
        raise click.UsageError("--points goes with a session")
    elif tip is None:
        raise click.UsageError("two URDFs need --tip LINK")
    else:
        result = _robots(urdf, other, tip, base, poses or 1000, seed)
    if as_json:
        click.echo(json.dumps(result, indent=2))
    else:
        _print(result)


def _robots(a: str, b: str, tip: str, base: str | None, poses: int, seed: int) -> dict[str, Any]:
    import numpy as np

    from urdfcal.estimation.evaluation import compare
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.urdf.urdf import Urdf, find_urdf

    chain_a, chain_b = (Chain.from_urdf(Urdf.read(find_urdf(path)), tip, base) for path in (a, b))
    q = chain_a.random_values(poses, np.random.default_rng(seed))
    difference = compare(chain_a, chain_b, q)
    return {
        "a": a,
        "b": b,
        "poses": poses,
        "seed": seed,
        "position_mm": _spread(difference.position, 1e3),
        "orientation_mrad": _spread(difference.orientation, 1e3),
        "position_unaligned_mm": _spread(difference.position_unaligned, 1e3),
        "orientation_unaligned_mrad": _spread(difference.orientation_unaligned, 1e3),
    }


def _session(urdf: str, folder: Path, points: Path | None) -> dict[str, Any]:
    import numpy as np

    from urdfcal.estimation.evaluation import explain
    from urdfcal.io.folder import read_points, read_session
    from urdfcal.robot.chain import read_mechanism
    from urdfcal.robot.urdf.urdf import Urdf, find_urdf

    session = read_session(folder)
    for warning in session.warnings:
        click.echo(f"- {warning}", err=True)
    if points is not None:
        measured, leds = read_points(points, session)
        extent = float(np.ptp(measured.xyz, axis=0).max())
        if extent > _FAR * session.chain.reach:
            raise SessionError(
                f"the points are spread over {extent:.0f} m, the arm reaches {session.chain.reach:.1f} m",
                where=str(points),
                remedy="Coordinates are in metres; these look like millimetres.",
            )
        session = replace(session, measurements=(measured,), leds=leds)
    links = [tip.link for tip in session.chain.tips]
    chain = read_mechanism(Urdf.read(find_urdf(urdf)), links, session.chain.base_link)
    explained = explain(chain, session)
    result: dict[str, Any] = {"a": urdf, "session": str(folder), "points": points and str(points)}
    for table, residual in zip(session.measurements, explained.residuals, strict=True):
        unit, scale = table.report
        result[f"residual_{unit}"] = {"sightings": len(residual), **_spread(np.linalg.norm(residual, axis=1), scale)}
    return result


def _spread(values: Floats, scale: float) -> dict[str, float]:
    from urdfcal.estimation.evaluation import Spread

    return {name: scale * value for name, value in asdict(Spread.of(values)).items()}


def _print(result: Mapping[str, Any]) -> None:
    from urdfcal.cli.console import output, sheet

    against = result.get("b") or result.get("points") or result["session"]
    rows = sheet(f"{result['a']}\nagainst {against}", ["", "rms", "mean", "median", "95 %", "max"])
    for name, spread in result.items():
        if isinstance(spread, dict):
            quantity, _, unit = name.rpartition("_")
            cells = [f"{spread[key]:.4f}" for key in ("rms", "mean", "median", "p95", "max")]
            rows.add_row(f"{quantity.replace('_', ' ')} ({unit})", *cells)
    output().print(rows)
