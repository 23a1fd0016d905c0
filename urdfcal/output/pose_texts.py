"""What the recording says beside the arm: each pose's residuals, and what colours and enlarged things mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.output.findings import counted, fastening_sentences, lenses_found, to_check
from urdfcal.output.palette import SIGMA_LEGEND
from urdfcal.typography import millimetres

if TYPE_CHECKING:
    from urdfcal.output.findings import Overview, ResultData

ELLIPSOID = 2.0
"""Half axes of the covariance ellipsoids, in standard deviations."""
_LEGEND = f"""\
Solid arm, or green where it has no meshes: **calibrated**. Blue ghost: **nominal**, {{placed}}.
{{enlarged}}

{{what}}: white as measured, green by the calibrated arm, blue by the nominal one. Arrows from measured to predicted,
thin at other poses: {SIGMA_LEGEND}. Purple: taken out of the fit. White ellipsoid: {ELLIPSOID:g} standard deviations
of the measurement, enlarged alike. Curves: residual of each {{one}}, in the arms' colours, with gaps where nothing was
seen{{means}}.
"""
_RAYS = "\nLong lines: the cameras' rays."
_DEPTH = " Along them a place is known several times worse than across; mm with depth hold both."
_ONE_RAY = " What a single camera saw has one ray, and no measured distance: its mm are across the ray."
# Lenses as given would put the nominal arm anywhere in space, and its own would be another world.
_LENSES = (
    " Nominal: px with the lenses as given, mm before the calibrated arm's cameras; on held-out poses each arm has "
    "lenses found for it."
)
_ENLARGED = "Its deviation and the residual arrows are enlarged **{factor:g} times**."
_TRUE_SIZE = "Its deviation and the residual arrows are large enough to be seen as they are."
_PLACED = "placed to fit best"
_LAID_OVER = (
    "drawn at the calibrated base. These poses cannot tell where LEDs or cameras sit on their links{known}: the "
    "nominal arm fits best {apart:.3g} mm away, which is no error of the arm"
)


def pose_texts(overview: Overview) -> list[str]:
    """For each pose its residuals in space, and what colours and enlarged things mean."""
    scene, session = overview.scene, overview.calibration.session
    poses, names, leds = session.poses, (*session.led_names, *session.attachments.targets), scene.leds
    # Along the ray of a single camera nothing was measured: how far the nominal arm is off there is unknown.
    off = [of - leds.measured for of in (leds.predicted, leds.nominal)]
    across = [v - np.sum(v * leds.ray, axis=1, keepdims=True) * leds.ray for v in off]
    new, old = (1e3 * np.linalg.norm(v, axis=1) for v in across)
    alone = np.asarray(leds.ray.any(axis=1))
    lines: list[list[str]] = [[] for _ in poses]
    for table in scene.tables if scene.pixels is not None else ():
        (where, after), (_, before) = (table.rms_by(table.pose, table.by_arm[arm]) for arm in ("calibrated", "nominal"))
        for pose, new_rms, old_rms in zip(where, after, before, strict=True):
            lines[pose].append(f"{new_rms:.2g} {table.unit} rms, nominal {old_rms:.2g}")
    for m, (pose, led, cut) in enumerate(zip(leds.pose, leds.led, leds.outlier, strict=True)):
        taken_out = ", taken out of the fit" if cut else ""
        how = "" if scene.pixels is None else ", across the ray" if alone[m] else ", depth included"
        lines[pose].append(f"{names[led]} {new[m]:.2f} mm off{how}, nominal {old[m]:.2f} mm{taken_out}")
    what = counted(overview.document).removesuffix("s").capitalize()
    legend, lenses = _legend(overview), _LENSES if lenses_found(overview.document) else ""
    return [
        f"**{what} {pose}**: {'; '.join(line) or 'nothing seen'}.{lenses}\n\n{legend}"
        for pose, line in zip(poses, lines, strict=True)
    ]


def _legend(overview: Overview) -> str:
    """What colours and enlarged things mean, below what is to be checked."""
    scene = overview.scene
    enlarged = _ENLARGED.format(factor=scene.factor) if scene.factor > 1.0 else _TRUE_SIZE
    known = _known_on_links(overview.document)
    placed = _LAID_OVER.format(apart=1e3 * scene.apart, known=known) if scene.apart else _PLACED
    one = counted(overview.document).removesuffix("s")
    what = "LED" if overview.calibration.session.leds else "Point"
    means = "; of more frames than there is room for, means" if one == "frame" else ""
    legend = _LEGEND.format(enlarged=enlarged, placed=placed, one=one, what=what, means=means)
    if scene.pixels is not None:
        alone = np.asarray(scene.leds.ray.any(axis=1))
        legend += f"{_RAYS}{'' if alone.all() else _DEPTH}{_ONE_RAY if alone.any() else ''}\n"
    if fastened := fastening_sentences(overview.calibration.session):
        legend += "\n" + " ".join(fastened) + "\n"
    if reasons := to_check(overview.calibration):
        legend = "**To check:**\n" + "\n".join(f"- {text}" for text in reasons) + f"\n\n{legend}"
    return legend


def _known_on_links(document: ResultData) -> str:
    """How well the places of LEDs, targets and cameras on their links are known, the worst of them."""
    sigmas = [led["sigma"] for led in document["leds"].values()]
    sigmas += [target["sigma"][:3] for target in document["targets"].values()]
    sigmas += [camera["sigma"].get("T_link_camera", ())[:3] for camera in document["cameras"].values()]
    worst = max((sigma for each in sigmas for sigma in each if sigma is not None), default=0.0)
    return f" (± {millimetres(worst)} mm)" if worst else ""
