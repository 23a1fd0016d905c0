"""Options that several commands share."""

from __future__ import annotations

import click

tip_option = click.option("--tip", required=True, metavar="LINK", help="Link at the end of the chain.")
base_option = click.option("--base", metavar="LINK", help="Link at its start.  [default: the root link]")
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all random numbers."
)
