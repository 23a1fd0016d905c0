"""The report: one page that needs nothing else, for archiving with the robot."""

from __future__ import annotations

import json
from datetime import datetime, timezone
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np

from urdfcal import files
from urdfcal.estimation.blocks.arm import LENGTHS
from urdfcal.output import charts, figures
from urdfcal.output.findings import HEADLINE, Overview, claims, look_up
from urdfcal.output.palette import SIGMA_LEGEND, UNMEASURED
from urdfcal.output.texts import MOUNTS, fastening_sentences, fixed_parameters, listed
from urdfcal.robot.tree_dh import MOUNT
from urdfcal.session.exclusion import summary

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from markupsafe import Markup

    from urdfcal.output.findings import ResultData
    from urdfcal.result.fitted import FittedCalibration

_TEMPLATE = "report.html.jinja"
_OUTLIERS_SHOWN = 25
_MINUS = "\N{MINUS SIGN}"


def write_report(
    path: Path, calibration: FittedCalibration, overview: Overview | None = None, *, refused: bool = False
) -> None:
    """Write a calibration as one HTML page: verdict first, figures inside, no scripts, nothing fetched.

    Args:
        path: the file; replaced in one step.
        calibration: what to report.
        overview: ``Overview.of(calibration)``, if it is there already.
        refused: whether nothing else is written of it.

    Raises:
        OutputError: the file cannot be written.
    """
    import jinja2
    from markupsafe import Markup

    overview = overview or Overview.of(calibration)
    document = overview.document
    svgs = figures.draw(overview)
    outliers = document["outliers"]
    largest = sorted(range(len(outliers)), key=lambda i: -outliers[i]["sigmas"])[:_OUTLIERS_SHOWN]
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(resources.files(__package__).joinpath(_TEMPLATE).read_text(encoding="utf-8"))
    page = template.render(
        document,
        n=_number_of(document),
        meaning=HEADLINE,
        claims=claims(document),
        misfit=_misfit(document["fit"]["reduced_chi2"]),
        figures={name: Markup(svg) for name, svg in svgs.items()},  # noqa: S704  # made by us, labels escaped
        sigma_legend=SIGMA_LEGEND,
        unmeasured=f"rgb{UNMEASURED}",
        share=f"{100.0 * overview.workspace.measured.mean():.0f} %",
        rows=_rows(document),
        columns=[
            f"{charts.SYMBOLS.get(c, c)} [{'mm' if c in LENGTHS else 'mrad'}]" for c in calibration.geometry.columns
        ],
        is_dh=calibration.geometry is calibration.table,
        tips=listed([tip.link for tip in calibration.chain.tips]),
        fastened=" ".join(fastening_sentences(calibration.session)),
        excluded=summary(calibration.session.excluded.named),
        mounts=MOUNTS if any(label.endswith(MOUNT) for label in calibration.geometry.labels) else "",
        fixed=fixed_parameters(document),
        largest=largest,
        shown=_OUTLIERS_SHOWN,
        refused=refused,
        urdf_name=calibration.urdf_name,
        date=f"{datetime.now(timezone.utc):%Y-%m-%d}",
    )
    files.write_text(path, page)


def _misfit(chi2: float | None) -> str:
    return "of unknown size in" if chi2 is None else f"{np.sqrt(chi2):.2g} times"


def _number_of(document: ResultData) -> Callable[..., Markup]:
    """What writes a number of ``calibration.json`` into the page, its full value and key beside it.

    No number gets into a table any other way, so that page and JSON cannot disagree.
    """
    from markupsafe import Markup

    def number(
        key: str | tuple[str | int, ...], digits: int | None = None, scale: float = 1.0, signed: bool = False
    ) -> Markup:
        path = tuple(key.split(".")) if isinstance(key, str) else tuple(map(str, key))
        value = look_up(document, path)
        if value is None:
            text = "unknown"
        elif digits is None:
            text = f"{scale * value:.3g}"
        else:  # rounding first, or tiny negative numbers print as -0.000
            text = f"{round(scale * value, digits) + 0.0:{'+' if signed else ''}.{digits}f}"
        return Markup('<data value="{}" data-key="{}">{}</data>').format(
            json.dumps(value), "/".join(path), text.replace("-", _MINUS)
        )

    return number


def _rows(document: ResultData) -> list[tuple[str, list[int]]]:
    """Joint by joint, which entries of the DH list are its five parameters."""
    rows: dict[str, list[int]] = {}
    for i, entry in enumerate(document["dh"]):
        rows.setdefault(entry["joint"], []).append(i)
    return list(rows.items())
