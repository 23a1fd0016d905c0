"""``urdfcal dh``: print a robot's Denavit-Hartenberg table."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from urdfcal.cli.options import base_option, tip_option

if TYPE_CHECKING:
    from urdfcal.robot.dh import Convention, DHTable


@click.command("dh")
@click.argument("urdf", metavar="ROBOT.urdf")
@tip_option
@base_option
@click.option(
    "--convention",
    type=click.Choice(["standard", "modified"]),
    default="standard",
    show_default=True,
    help="Distal rows (Rossi's eq. 2), or Craig's.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
def command(urdf: str, tip: str, base: str | None, convention: Convention, as_json: bool) -> None:
    """Print the Denavit-Hartenberg rows of a robot's chain of joints."""
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.dh import DHTable
    from urdfcal.robot.urdf.urdf import Urdf, find_urdf

    table = DHTable.from_chain(Chain.from_urdf(Urdf.read(find_urdf(urdf)), tip, base))
    if as_json:
        click.echo(json.dumps(table.to_dict(convention), indent=2))
    else:
        _print(table, convention)


def _print(table: DHTable, convention: Convention) -> None:
    import numpy as np

    from urdfcal.cli.console import output, sheet

    data = table.to_dict(convention)
    order = ("theta", "d", "a", "alpha", "beta") if convention == "standard" else ("a", "alpha", "beta", "theta", "d")
    scales = {name: (1e3, "mm") if name in "da" else (np.degrees(1.0), "deg") for name in order}
    rows = sheet(
        f"{table.chain.name}: {table.chain.base_link} to {table.chain.tip_link}, {convention} DH",
        ["joint", "type", *(f"{name} ({unit})" for name, (_, unit) in scales.items())],
        texts=2,
    )
    for row in data["rows"]:
        # Rounding first, or tiny negative numbers print as -0.0000.
        cells = [f"{round(scale * row[name], 4) + 0.0:.4f}" for name, (scale, _) in scales.items()]
        rows.add_row(row["joint"], row["type"], *cells)
    console = output()
    console.print(rows)
    console.print(data["composition"])
    for name in ("base", "tool"):
        matrix = np.round(data[name], 6) + 0.0
        console.print(f"{name} = {np.array2string(matrix, suppress_small=True, prefix='base = ')}")
