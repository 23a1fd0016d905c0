"""Templates of pages: one HTML file each that needs nothing else."""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Template

_UNIT = re.compile(r"(\d(?:</data>)?) (?=±|%|(?:mm|mrad|px|deg|rad|kg)\b)")
_SIGMA = re.compile(r"± (?=[\d<])")
_UNBROKEN = "\N{NO-BREAK SPACE}"


def tied(page: str) -> str:
    """Keep numbers of a page and their units, and standard deviations, in one line each."""
    return _SIGMA.sub(f"±{_UNBROKEN}", _UNIT.sub(rf"\1{_UNBROKEN}", page))


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
