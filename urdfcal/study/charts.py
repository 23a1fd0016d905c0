"""The charts of a study: the tip's error against each thing that was varied."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.output import palette
from urdfcal.output.chart import Chart, Mark, Scale
from urdfcal.study.monte_carlo import VARIED, present

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.session.rig_description import RigDescription
    from urdfcal.study.monte_carlo import Outcome, Varied

_LABELS: dict[Varied, str] = {
    "poses": "poses",
    "pixel": "noise of detections [px]",
    "baseline": "times as far from the first camera",
    "lens": "times the focal length",
    "cameras": "cameras",
    "leds": "LEDs",
    "arm": "times as far off its drawing",
}


def study_charts(rig: RigDescription, table: Sequence[Outcome]) -> tuple[Chart, ...]:
    """Draw a chart for each thing that was varied, the rig as it is among its values; on one scale of errors."""
    there = [one for one in table if one.arms]
    if not there:
        return ()
    errors = Scale.holding(*(1e3 * np.array([*one.arms, one.expected]) for one in there), logarithmic=True)
    names = [name for name in VARIED if any(one.setting.varied == name for one in there)]
    return tuple(_chart(rig, name, there, errors) for name in names)


def _chart(rig: RigDescription, name: Varied, table: Sequence[Outcome], errors: Scale) -> Chart:
    by_value = {present(rig, name): one for one in table if one.setting.varied is None}
    by_value |= {one.setting.value: one for one in table if one.setting.varied == name}
    values = np.array(sorted(by_value))
    rows = [by_value[value] for value in values.tolist()]
    arms = 1e3 * np.concatenate([one.arms for one in rows])
    marks = [
        Mark("dots", "each arm", np.repeat(values, [len(one.arms) for one in rows]), arms, palette.INK),
        Mark("hairlines", "expected", values, [1e3 * one.expected for one in rows], palette.NOMINAL),
        Mark("lines", "rms", values, [1e3 * one.error for one in rows], palette.CALIBRATED),
    ]
    x = Scale.holding(values, whole=name in ("poses", "cameras", "leds"))
    title = f"Tip error by {'LEDs' if name == 'leds' else name} [mm]"
    return Chart(f"study {name}", title, x, errors, marks, _LABELS[name], legend=("each arm", "expected", "rms"))
