"""The command line: parse, run, report errors; commands of one purpose share a module."""

from __future__ import annotations

import atexit
import gc
import sys
from typing import TYPE_CHECKING

import click

from urdfcal.cli import (
    batch,
    calibrate,
    cameras,
    export,
    guide,
    import_,
    judging,
    plan,
    results,
    robots,
    simulate,
    study,
)
from urdfcal.cli.console import say
from urdfcal.errors import UrdfcalError

if TYPE_CHECKING:
    from collections.abc import Sequence

# Characters of a command's first sentence: more than any has.
_WHOLE = 1000


class _Commands(click.Group):
    """Commands of which each one's first sentence is listed whole."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        named = {name: self.commands[name] for name in self.list_commands(ctx)}
        with formatter.section("Commands"):
            formatter.write_dl([(name, of.get_short_help_str(_WHOLE)) for name, of in named.items()])


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110, "show_default": True},
    epilog="Any command: --debug shows the traceback of an error.",
)
@click.version_option(package_name="urdfcal")
def cli() -> None:
    """Make the URDF match the arm, with two cameras and an LED."""


_TO_A_RESULT = (
    simulate.demo,
    simulate.simulate,
    import_.command,
    cameras.command,
    plan.command,
    calibrate.detect,
    calibrate.command,
)
_FROM_A_RESULT = (robots.evaluate, robots.dh, results.view, results.compensate, results.apply, export.command)
_MANY = (batch.command, study.command)
_JUDGING_RESULTS = (judging.verify, judging.compare)
for _command in (*_TO_A_RESULT, *_MANY, *_FROM_A_RESULT, *_JUDGING_RESULTS, guide.command):
    cli.add_command(_command)


def run(arguments: Sequence[str]) -> int:
    """Run one command line and say how it ended: 0 well, 1 a calibration failed its checks, 2 bad input.

    Of ``verify`` 1 is not shown to be within the limit, of ``compare`` that the arm changed.
    """
    debug = "--debug" in arguments
    try:
        # What a command ends with by ``ctx.exit`` comes back as a number.
        ended = cli.main([a for a in arguments if a != "--debug"], prog_name="urdfcal", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except click.Abort:
        click.echo("interrupted", err=True)
        return 130
    except UrdfcalError as error:
        if debug:
            raise
        say(f"urdfcal: {error}", err=True)
        return error.exit_code
    return ended if isinstance(ended, int) else 0


def main() -> None:
    """Entry point of the ``urdfcal`` command."""
    # A process of one command: looking for garbage while libraries load, and through all of them at exit, is a tenth
    # of `urdfcal calibrate` (2.19 -> 1.92 s). Cycles of ours are few; they are still collected, by 200,000 objects.
    gc.set_threshold(200_000)
    atexit.register(gc.freeze)
    sys.exit(run(sys.argv[1:]))
