"""The report: one HTML page that needs nothing else, for screens wide, narrow, light and dark, and for paper."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import PurePath
from typing import TYPE_CHECKING

import numpy as np

from urdfcal import files
from urdfcal.cameras.lens import COEFFICIENTS
from urdfcal.estimation.assessment import NOISE_OFF
from urdfcal.estimation.blocks.arm import LENGTHS, ArmBlock
from urdfcal.estimation.model_selection import CERTAIN, Trial
from urdfcal.estimation.model_spec import allowed
from urdfcal.output.charts import SYMBOLS
from urdfcal.output.figures import figures
from urdfcal.output.findings import (
    MOUNTS,
    claims,
    counted,
    fastening_sentences,
    fixed_parameters,
    lenses_found,
    listed,
    look_up,
    meaning,
    residual_rows,
    scale_moves,
    to_check,
)
from urdfcal.output.page import template
from urdfcal.output.palette import SIGMA_LEGEND
from urdfcal.output.portrait import portrait
from urdfcal.output.svg import figure_html
from urdfcal.output.texts import (
    AS_GIVEN,
    NO_DIFFERENCE,
    cost_rises,
    directions,
    following,
    moved_most,
    noise_of,
    none_alone,
    thinned,
    together,
    unseen,
)
from urdfcal.output.worst import worst
from urdfcal.robot.tree_dh import MOUNT
from urdfcal.session.exclusion import summary
from urdfcal.session.trajectory import Trajectory
from urdfcal.typography import tied

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.output.findings import Overview, ResultData
    from urdfcal.result.fitted import FittedCalibration

_TEMPLATE = "output/report.html.jinja"
_OUTLIERS_SHOWN = 25
_MINUS = "\N{MINUS SIGN}"
# Parameters that are correlated more are told apart by little, and so many pairs are shown.
_CORRELATED, _PAIRS = 0.9, 12
# An LED's place that is known worse is told by predictions alone. [m]
_HARDLY_KNOWN = 0.005


def write_report(path: Path, overview: Overview, *, refused: bool = False) -> None:
    """Write a calibration as one HTML page: verdict first, figures inside, no scripts, nothing fetched.

    Args:
        path: the file; replaced in one step.
        overview: what to report.
        refused: whether nothing else is written of it.

    Raises:
        OutputError: the file cannot be written.
    """
    from markupsafe import Markup

    calibration, document = overview.calibration, overview.document

    def number(
        key: str | tuple[str | int, ...], digits: int | None = None, scale: float = 1.0, signed: bool = False
    ) -> Markup:
        """Write a number of ``calibration.json`` into the page, its full value and key beside it.

        No number gets into a table any other way, so that page and JSON cannot disagree.
        """
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

    pairs, missed = _correlated_pairs(calibration), worst(overview)
    outliers, chi2 = document["outliers"], document["fit"]["reduced_chi2"]
    largest = sorted(range(len(outliers)), key=lambda i: -outliers[i]["sigmas"])[:_OUTLIERS_SHOWN]
    rows: dict[str, list[int]] = {}  # joint by joint, which entries of the DH list are its parameters
    for i, entry in enumerate(document["dh"]):
        rows.setdefault(entry["joint"], []).append(i)
    page = template(
        _TEMPLATE
    ).render(
        document,
        n=number,
        meaning=meaning(document),
        claims=claims(document),
        counted=counted(document),
        residual_rows=residual_rows(document),
        misfit="of unknown size in" if chi2 is None else f"{np.sqrt(chi2):.2g} times",
        as_given=AS_GIVEN if lenses_found(document) else "",
        no_difference=NO_DIFFERENCE,
        cost_rises=cost_rises(overview),
        directions=directions(overview),
        moved_most=moved_most(overview),
        none_alone=none_alone(overview),
        thinned=thinned(overview),
        noise_of=noise_of(overview),
        together=together(overview.scene.tables[0]),
        unseen=unseen(overview),
        moving=isinstance(calibration.session.motion, Trajectory),
        noise_named=NOISE_OFF,
        certain=CERTAIN,
        not_chosen=_not_chosen(calibration),
        portrait=portrait(overview),
        worst=[replace(miss, crop=Markup(miss.crop)) for miss in missed],  # noqa: S704  # as of figures
        numbered=any(miss.pose.lstrip("0") != str(miss.number) for miss in missed),
        pairs=pairs[:_PAIRS],
        pair_count=len(pairs),
        correlated=_CORRELATED,
        hardly_known=_hardly_known(document),
        short=_short,
        reasons=to_check(calibration),
        figures={name: Markup(figure_html(figure)) for name, figure in figures(overview).items()},  # noqa: S704  # made by us, labels escaped
        sigma_legend=SIGMA_LEGEND,
        actuated=len(calibration.chain.actuated),
        sags=overview.workspace.moved is not None,
        scale_moves=scale_moves(document["scale"]),
        share=f"{100.0 * overview.workspace.measured.mean():.2g} %" if overview.workspace.measured.any() else "",
        rows=list(rows.items()),
        columns=[f"{SYMBOLS.get(c, c)} [{'mm' if c in LENGTHS else 'mrad'}]" for c in calibration.geometry.columns],
        is_dh=calibration.geometry is calibration.table,
        after=following(calibration),
        coefficients=COEFFICIENTS,
        world=_world(calibration),
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
    files.write_text(path, tied(page))


def _short(name: str) -> str:
    """A file's name as a page shows it, which others may read: without the folders of this machine."""
    return PurePath(name).name if PurePath(name).is_absolute() else name


def _hardly_known(document: ResultData) -> list[str]:
    """LEDs whose place is hardly known."""
    return [
        name
        for name, led in document["leds"].items()
        if any(sigma is not None and sigma > _HARDLY_KNOWN for sigma in led["sigma"])
    ]


def _world(calibration: FittedCalibration) -> str:
    """Whose frame the world is."""
    attachments = calibration.session.attachments
    cameras = calibration.estimate.cameras  # none where their points are what is estimated from
    standing = [cameras[c].name for c in attachments.eye_to_hand if c < len(cameras)]
    return f"the frame of camera {standing[0]}" if standing else "the frame that was measured in"


def _not_chosen(calibration: FittedCalibration) -> list[str]:
    """Of each model that predicts unseen poses better than the chosen one, why it was not chosen."""
    comparison, said = calibration.comparison, []
    for attempt in comparison.attempts:
        better = isinstance(attempt, Trial) and attempt.loss < comparison.chosen.loss
        kept = allowed(calibration.session, attempt.spec)
        said.append("" if not better else "within chance" if kept else "the session says otherwise")
    return said


def _correlated_pairs(calibration: FittedCalibration) -> list[tuple[str, str, float]]:
    """Pairs of the arm's parameters and others whose errors go together, the most correlated first.

    Those of which neither is the arm's, such as two LEDs' places, do not matter to it.
    """
    parameters = calibration.fit.parameters
    names = [name for name, active in zip(parameters.names, parameters.active, strict=True) if active]
    own = {name for block in parameters.blocks if isinstance(block, ArmBlock) for name in block.names}
    sigma = np.sqrt(np.diag(calibration.fit.covariance))
    correlation = np.triu(calibration.fit.covariance / np.outer(sigma, sigma), 1)
    found = np.argwhere(np.abs(correlation) > _CORRELATED).tolist()
    pairs = [(names[i], names[j], float(correlation[i, j])) for i, j in found if own & {names[i], names[j]}]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))
