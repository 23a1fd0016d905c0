"""What several commands take: paths, links, seeds, a result."""

from pathlib import Path

import click

PATH = click.Path(path_type=Path)
POSITIVE = click.FloatRange(min=0.0, min_open=True)

result_argument = click.argument("result", type=PATH, metavar="OUT")
tip_option = click.option("--tip", required=True, metavar="LINK", help="Link at the end of the chain.")
base_option = click.option("--base", metavar="LINK", help="Link at its start.  [default: the root link]")
seed_option = click.option("--seed", type=click.IntRange(min=0), default=0, help="Seed of all random numbers.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
