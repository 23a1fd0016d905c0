"""Templates of pages: one HTML file each that needs nothing else."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Template


@cache
def template(name: str) -> Template:
    """Read a page's template, such as ``output/report.html.jinja``; compiling it takes longer than filling it in."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(lambda of: resources.files("urdfcal").joinpath(of).read_text(encoding="utf-8")),
    )
    return environment.get_template(name)
