"""``urdfcal guide``: short how-tos, which any forge shows as well."""

from __future__ import annotations

import re
from importlib import resources

import click

TOPICS = {
    "first-arm": "What to measure, and what the answer means.",
    "cameras": "Calibrate them, convert files, put them on the arm.",
    "boards": "Boards and tags for LEDs, and how true a print is.",
    "no-camera": "A ball and sockets, a table, a ball bar, a tracker.",
    "moving-arm": "Film the arm while it moves; recordings of ROS.",
    "session": "Every file and key of a session, and imports.",
    "my-stack": "MoveIt, MuJoCo, LeRobot, controllers, your program.",
}
# What a terminal cannot show.
_PICTURE = re.compile(r"^!\[.*\n+", re.MULTILINE)


@click.command("guide")
@click.argument("topic", type=click.Choice(list(TOPICS)), required=False)
def command(topic: str | None) -> None:
    """Show a short how-to; without TOPIC, the list of them."""
    from rich.markdown import Markdown

    from urdfcal.cli.console import terminal

    if topic is None:
        width = max(map(len, TOPICS))
        for name, what in TOPICS.items():
            click.echo(f"urdfcal guide {name:{width}}  {what}")
        return
    console = terminal()
    text = _PICTURE.sub("", read(topic))
    if console.is_terminal:
        console.print(Markdown(text))
    else:  # it reads well as it is, and can be kept
        click.echo(text, nl=False)


def read(topic: str) -> str:
    """The text of a how-to, in Markdown."""
    return (resources.files("urdfcal") / "guide" / f"{topic}.md").read_text(encoding="utf-8")
