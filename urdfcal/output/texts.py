"""The texts of report and recording: the legend, the table of DH rows, and which link carries what."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from urdfcal.estimation.blocks.arm import LENGTHS
from urdfcal.output.charts import CONVERGENCE, PART_COLORS, RESIDUALS
from urdfcal.output.findings import HEADLINE, headline
from urdfcal.output.palette import SIGMA_LEGEND
from urdfcal.robot.tree_dh import MOUNT

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from urdfcal.output.findings import Overview, ResultData
    from urdfcal.output.stream import Layer
    from urdfcal.session.model import Setup

ELLIPSOID = 2.0
"""Half axes of the covariance ellipsoids, in standard deviations."""
MOUNTS = (
    f"A row that ends in {MOUNT} leads from an axis of the link that carries a further branch to that branch's "
    "first joint axis."
)
_LEGEND = f"""\
Solid arm: **calibrated**. Blue ghost: **nominal**, as the URDF has it, placed to fit the measurements best. Its
deviation and the residual arrows are enlarged **{{factor:g}} times**.

LED: white as measured, green by the calibrated arm, blue by the nominal one. Arrows from measured to predicted:
{SIGMA_LEGEND}. Purple: taken out of the fit. White ellipsoid: {ELLIPSOID:g} standard deviations of the measurement,
enlarged alike.
"""


def log_texts(base: Layer, overview: Overview) -> None:
    """Log the verdict, what there is to see at each pose, the table of the DH rows, and the poses' names."""
    session = overview.calibration.session
    banner = f"{overview.assessment.sentence}   {headline(overview.document)}, {HEADLINE}"
    base.at("banner").fixed(rr.Points2D([[0.0, 0.0]], radii=0.0, labels=banner, show_labels=False))
    texts = base.at("texts")
    texts.at("about").fixed(rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN))
    texts.at("about").each(rr.TextDocument.columns(text=_about(overview)))
    colored = zip(PART_COLORS, overview.scene.tables[0].components, strict=False)
    parts = ", ".join(f"{color}: {name}" for color, name in colored)
    for name, text in (
        ("parameters", parameter_text(overview.document)),
        ("residuals", RESIDUALS.format(parts=parts)),
        ("convergence", CONVERGENCE),
    ):
        texts.at(name).fixed(rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
    texts.at("poses").fixed(rr.AnyValues(poses=session.poses))


def _about(overview: Overview) -> list[str]:
    """For each pose its residuals in space, and what colours and enlarged things mean."""
    scene, session = overview.scene, overview.calibration.session
    poses, names, leds = session.poses, (*session.led_names, *session.attachments.targets), scene.leds
    new, old = (1e3 * np.linalg.norm(of - leds.measured, axis=1) for of in (leds.predicted, leds.nominal))
    lines: list[list[str]] = [[] for _ in poses]
    for m, (pose, led, cut) in enumerate(zip(leds.pose, leds.led, leds.outlier, strict=True)):
        taken_out = ", taken out of the fit" if cut else ""
        lines[pose].append(f"{names[led]} {new[m]:.2f} mm off, nominal {old[m]:.2f} mm{taken_out}")
    legend = _LEGEND.format(factor=scene.factor)
    if fastened := fastening_sentences(session):
        legend += "\n" + " ".join(fastened) + "\n"
    if overview.assessment.reasons:
        legend += "\n**To check:**\n" + "\n".join(f"- {text}" for text in overview.assessment.reasons)
    return [
        f"**Pose {pose}**: {'; '.join(line) or 'nothing seen'}.\n\n{legend}"
        for pose, line in zip(poses, lines, strict=True)
    ]


def fixed_parameters(document: ResultData) -> list[tuple[str, list[str]]]:
    """The parameters that were fixed for a reason not among the unidentifiable directions, reason by reason."""
    fixed: dict[str, list[str]] = {}
    for entry in document["dh"]:
        if entry["status"] == "fixed" and entry["reason"] not in document["identifiability"]["lost"]:
            fixed.setdefault(entry["reason"], []).append(f"{entry['joint']}.{entry['parameter']}")
    return list(fixed.items())


def parameter_text(document: ResultData) -> str:
    """The DH rows as a table in Markdown, nominal value and offset ± standard deviation, and what was fixed and why."""
    entries: Sequence[Mapping[str, Any]] = document["dh"]
    names = list(dict.fromkeys(entry["parameter"] for entry in entries))
    columns = [f"{name} [{'mm' if name in LENGTHS else 'mrad'}]" for name in names]
    lines = [f"| row | joint | {' | '.join(columns)} |", f"|---|---|{'---|' * len(columns)}"]
    for number, first in enumerate(range(0, len(entries), len(names)), start=1):
        row = entries[first : first + len(names)]
        lines.append(f"| {number} | {row[0]['joint']} | {' | '.join(map(_cell, row))} |")
    unidentifiable = document["identifiability"]["lost"]
    text = "\n".join(lines)
    text += f"\n\n{MOUNTS}" if any(entry["joint"].endswith(MOUNT) for entry in entries) else ""
    text += (
        "\n\n**Unidentifiable:**\n" + "\n".join(f"- {sentence}" for sentence in unidentifiable)
        if unidentifiable
        else ""
    )
    if fixed := fixed_parameters(document):
        text += "\n\n**Not estimated:**\n" + "\n".join(f"- {', '.join(which)}: {why}" for why, which in fixed)
    condition = document["identifiability"]["condition_number"]
    return f"{text}\n\nCondition number {condition:.3g} (above 100 some parameters are poorly determined).\n"


def _cell(entry: Mapping[str, Any]) -> str:
    nominal = f"{round(1e3 * entry['nominal'], 3) + 0.0:.3f}"
    if entry["status"] == "fixed":
        return nominal
    return f"{nominal} **{1e3 * entry['offset']:+.3f}** ± {1e3 * entry['sigma']:.3f}"


def fastening_sentences(session: Setup) -> tuple[str, ...]:
    """Say which link carries which LED and camera, and what the figures mean then.

    Nothing is said where every LED is on the tip link and every camera is fixed in the world.
    """
    frames, chain = session.attachments, session.chain
    if len(chain.tips) == 1 and np.all(frames.led == 1) and not session.mounts:
        return ()
    parts = []
    carried = [(led.name, frame) for led, frame in zip(session.leds, frames.led.tolist(), strict=False)]
    carried += [(f"target {name}", carrier) for name, carrier in frames.carried]
    for frame in sorted({frame for _, frame in carried}):
        names = [name for name, of in carried if of == frame]
        where = f"on {frames.frames[frame]}" if frame else "fixed in the world"
        parts.append(f"{listed(names)} {where}")
    sentences = [f"{'LEDs' if session.leds else 'Seen'}: {'; '.join(parts)}."]
    sentences += [
        f"Camera {mount.camera} is on {mount.link}: an error in mm is how far an LED is, across the camera's ray, from "
        "where the joints between the two put it."
        for mount in session.mounts
    ]
    carriers = [mount.link for mount in session.mounts]
    if any(carriers.count(link) == 1 for link in carriers):
        sentences.append("An LED that one camera alone sees is shown on its ray, at the predicted distance.")
    if len(chain.tips) > 1:
        sentences.append(f"Figures of the tip and its workspace are about {chain.tip_link}.")
    return tuple(sentences)


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence: one, two and three."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
