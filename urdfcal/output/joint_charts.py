"""The charts of what each joint does: its share of the tip error, and its joint models beside what is seen of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import rms
from urdfcal.estimation.contributions import GEOMETRY, contributions
from urdfcal.estimation.partial_residuals import partial_residuals
from urdfcal.output import palette
from urdfcal.output.chart import Chart, Mark, Scale, bars

if TYPE_CHECKING:
    from urdfcal.result.fitted import FittedCalibration

# What is less than this share of the largest is not seen, and more bars than this are a wall.
_LEAST, _MOST = 0.01, 12
# A joint model of less than this share of what is left is not seen in its chart.
_SEEN = 0.1


def contribution_chart(calibration: FittedCalibration) -> Chart | None:
    """What was wrong with this arm, the largest first; None where nothing of it was estimated."""
    found = [of for of in contributions(calibration.problem, calibration.fit) if of.tip > 0.0]
    shown = [of for of in found[:_MOST] if of.tip > _LEAST * found[0].tip]
    if not shown:
        return None
    tip, margin = (1e3 * np.array([getattr(of, name) for of in shown]) for name in ("tip", "sigma"))
    y = np.arange(len(shown), 0.0, -1.0)
    ends = np.stack([np.maximum(tip - 1.96 * margin, 0.0), tip + 1.96 * margin], axis=-1)
    across, along = bars(y, tip, 0.3)
    names = {place: f"{of.joint} {of.what}" for place, of in zip(y.tolist(), shown, strict=True)}
    height = Scale(0.3, len(shown) + 0.7, names=names)
    geometry = np.array([of.what == GEOMETRY for of in shown])
    some = f": {len(shown)} largest of {len(found)}" if len(shown) < len(found) else ""
    return Chart(
        "contributions",
        f"Tip error by cause{some}",
        Scale(0.0, 1.05 * float(ends.max())),
        height,
        [
            Mark("bars", "geometry", along[geometry], across[geometry], palette.NOMINAL),
            Mark("bars", "joint models", along[~geometry], across[~geometry], palette.ACCENT),
            Mark("lines", "intervals", ends, np.stack([y, y], axis=-1), palette.INK),
        ],
        x_label="how far it moves the tip, rms [mm]",
    )


def joint_model_charts(calibration: FittedCalibration) -> list[Chart]:
    """Each joint model that was estimated, joint by joint, over what it depends on."""
    charts = []
    for of in partial_residuals(calibration.problem, calibration.fit):
        if rms(of.value) < _SEEN * rms(of.left):
            continue
        order = np.argsort(of.at, kind="stable")
        before, left, model = 1e3 * (of.value + of.left), 1e3 * of.left, 1e3 * of.value
        reach = float(np.percentile(np.abs(np.concatenate([before, left])), 98.0))
        largest = 1.1 * max(reach, float(np.abs(model).max()), 1e-6)
        charts.append(
            Chart(
                f"{of.model} of {of.joint}",
                f"{of.joint}: {of.model} [{'mm' if of.unit == 'm' else 'mrad'}]",
                Scale.holding(of.at),
                Scale(-largest, largest),
                [
                    Mark("dots", "nominal", of.at, before, palette.NOMINAL),
                    Mark("dots", "calibrated", of.at, left, palette.CALIBRATED),
                    Mark("lines", "model", of.at[order], model[order], palette.INK),
                ],
                x_label=of.axis,
            )
        )
    return charts
