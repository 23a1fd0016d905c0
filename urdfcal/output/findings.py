"""What report, recording and command line say of a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from urdfcal.estimation.blocks.arm import LENGTHS
from urdfcal.output.scene import CalibrationScene, build_scene
from urdfcal.output.workspace import Workspace, sample_workspace
from urdfcal.robot.tree_dh import MOUNT
from urdfcal.session.attachments import ends_of_arms

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Setup

ResultData: TypeAlias = "Mapping[str, Any]"
"""What is in ``calibration.json``."""

MOUNTS = (
    f"A row that ends in {MOUNT} leads from an axis of the link that carries a further branch to that branch's "
    "first joint axis."
)
# [mm]
_ROUNDING = 1e-6
_SEEN = {"detections": "in the images"}
_TRIANGULATED = "triangulated, depth included"
# A tip error so many times that of held-out poses is no matter of noise. Motoman's is 13 times, simulated rigs' 0.4.
_FAR_MORE = 3.0
# Of so few poses a fold takes a share that is felt: what they leave is farther off than the calibration from all.
_FEW = 20


@dataclass(frozen=True, eq=False)
class Overview:
    """A calibration and everything that report and recording show of it, worked out once for both.

    Attributes:
        calibration: the result.
        document: what ``calibration.json`` holds.
        scene: where everything is.
        workspaces: tip errors over the workspace, of each arm.
    """

    calibration: FittedCalibration
    document: ResultData
    scene: CalibrationScene
    workspaces: tuple[Workspace, ...]

    @property
    def workspace(self) -> Workspace:
        """Of the first tip."""
        return self.workspaces[0]

    @classmethod
    def of(cls, calibration: FittedCalibration) -> Overview:
        """Work it out."""
        ends = ends_of_arms(calibration.chain, calibration.session.attachments)
        workspaces = tuple(sample_workspace(calibration, tip) for tip in ends)
        return cls(calibration, calibration.to_dict(), build_scene(calibration), workspaces)


def headline(document: ResultData) -> str:
    """The rms error on held-out poses, nominal and calibrated."""
    validation = document["validation"]
    return f"{validation['rms_nominal_mm']:.3g} -> {validation['rms_mm']:.3g} mm"


def lenses_found(document: ResultData) -> bool:
    """Whether lenses were estimated with the arm: the nominal arm is judged with those as given, or its own."""
    return any(camera["sigma"].get("intrinsics") for camera in document["cameras"].values())


def meaning(document: ResultData) -> str:
    """What the one number means that says what a calibration is worth."""
    lenses = ", each arm with lenses found for it" if lenses_found(document) else ""
    return f"rms error on held-out {counted(document)}{lenses}"


def claims(document: ResultData) -> tuple[str, ...]:
    """What error of the tip is claimed and found, what that is conditional on, and what more poses would bring.

    Nothing in files that do not say it.
    """
    if "tip" not in document:
        drawn = not any("sigma" in entry for entry in document["dh"])
        return ("the arm is as drawn, nothing of it was estimated: of its tip nothing is claimed",) if drawn else ()
    tip, regions = document["tip"], document["regions"]
    interval = "{:.2g} to {:.2g}".format(*tip["interval_mm"])
    regions_mm = f"{regions['rms_mm']:.2g} mm where whole regions were held out"
    robot = document["robot"]
    tip_mm, whose = f"{tip['rms_mm']:.2g} mm rms", f"{robot['tip_link']} " if len(robot["tips"]) > 1 else ""
    across = ", across the cameras' rays" if document["cameras"] else ""
    poses, folds = document["fit"]["poses"], document["validation"]["folds"]
    few = f", from about {poses - poses // folds} of the {poses} poses at a time" if poses <= _FEW else ""
    return (
        f"that is against what was measured{across}, its noise included{few}; {regions_mm}",
        f"tip {whose}{tip_mm} (95 %: {interval}) expected over the workspace, bases aligned, noise apart",
        *_larger(document),
        _condition(document),
        *_in_left_out(document),
        *_more_poses(document),
    )


def counted(document: ResultData) -> str:
    """What the measurements are counted in: poses, or the frames of an arm that moved."""
    return "frames" if any("time_offset" in camera for camera in document["cameras"].values()) else "poses"


@dataclass(frozen=True)
class ResidualRow:
    """The residual of one kind of measurement, rms.

    Attributes:
        what: was measured.
        unit: of the residual.
        nominal: key, in the result, of that before calibration.
        calibrated: key of that after.
    """

    what: str
    unit: str
    nominal: tuple[str | int, ...]
    calibrated: tuple[str | int, ...]


def residual_rows(document: ResultData) -> tuple[ResidualRow, ...]:
    """The residuals of all kinds of measurements, and those of what cameras saw triangulated."""
    fit = document["fit"]
    rows = []
    found = lenses_found(document)
    for i, each in enumerate(fit["residuals"]):
        key, what = ("fit", "residuals", i), _SEEN.get(each["kind"], each["kind"])
        if found and each["unit"] == "px":
            what += ", the nominal arm's with the lenses as given"
        rows.append(ResidualRow(what, each["unit"], (*key, "rms_nominal"), (*key, "rms")))
    if document["cameras"] and "rms_mm" in fit and all(fit["rms_mm"] != each["rms"] for each in fit["residuals"]):
        rows.append(ResidualRow(_TRIANGULATED, "mm", ("fit", "rms_nominal_mm"), ("fit", "rms_mm")))
    return tuple(rows)


def _in_left_out(document: ResultData) -> tuple[str, ...]:
    """What was found in poses that were left out by name; nothing where there are none."""
    found = document["validation"].get("left_out")
    if found is None:
        return ()
    return (f"{found['rms_mm']:.2g} mm rms, at most {found['max_mm']:.2g}, in the {found['poses']} poses left out",)


def scale_moves(scale: ResultData) -> bool:
    """Whether the unit of length moves the tip: what moves it by less than a nanometre is rounding."""
    return bool(scale["tip_mm_per_permille"] > _ROUNDING)


def _condition(document: ResultData) -> str:
    """What a claimed error rests on: the unit of length."""
    scale: ResultData = document["scale"]
    permille = scale["tip_mm_per_permille"]
    if not scale_moves(scale):
        return "lengths are those of the nominal arm within its tolerances: nothing that was measured is a length"
    declared, factor = scale["declared_sigma"], ""
    if scale["factor_sigma"] is not None:
        # A sliding joint's readings are lengths, too, and better known than a drawing's.
        sliding = [name for name, of in document["robot"]["joints"].items() if of["type"] == "prismatic"]
        lengths = " and ".join(["the nominal arm's lengths", *(f"the readings of {name}" for name in sliding)])
        whose = f"{lengths} differ from it by" if declared is None else "it comes out off by"
        factor = f"; {whose} {1e2 * scale['factor']:+.2g} ± {1e2 * scale['factor_sigma']:.1g} %"
    tip = f"0.1 % of it is {permille:.2g} mm at the tip{factor}"
    if declared is not None:
        return f"the scale is known to {1e2 * declared:.2g} %, which is in the interval: {tip}"
    if scale.get("unit") == "distances":
        return f"if the known distances are right: 0.1 % of them is {permille:.2g} mm at the tip{factor}"
    return f"if the scale is right: {tip}"


def _larger(document: ResultData) -> tuple[str, ...]:
    """Why the tip's error is larger than held-out poses show: most of it is one factor of all lengths, or elsewhere."""
    tip = document["tip"]
    size = tip.get("size")
    if size is None or not size["is_limit"]:
        times = tip["rms_mm"] / max(document["validation"]["rms_mm"], document["regions"]["rms_mm"])
        if times < _FAR_MORE:
            return ()
        return (f"{times:.0f} times what held-out poses show: they are where it was measured, elsewhere less is known",)
    known = f"{size['rms_mm']:.2g} mm of it is one factor of all lengths, known to {1e2 * size['sigma']:.2g} %"
    before, after = f"{tip['rms_mm']:.2g}", f"{size['rms_without_mm']:.2g}"
    if before == after:  # where the model does not hold, that is the limit
        return ()
    return (f"{known}: a better known length would bring {before} -> {after} mm",)


def _more_poses(document: ResultData) -> tuple[str, ...]:
    """What further poses would bring; nothing in files that do not say it."""
    tip, what = document["tip"], counted(document)
    more = tip.get("more")
    if more is None:
        return ()
    if more["rms_mm"] is None:
        noise = document["fit"]["reduced_chi2"] ** 0.5
        return (f"the model is the limit, not the {what}: the residuals are {noise:.2g} times the declared noise",)
    again = more["poses"] == document["fit"]["poses"]
    count = f"as many {what} again" if again else f"{more['poses']} more {what}"
    before, after = f"{tip['rms_mm']:.2g}", f"{more['rms_mm']:.2g}"
    if before == after:
        return (f"{count} like these would bring next to nothing",)
    plan = "; urdfcal plan finds better poses" if document["cameras"] else ""
    return (f"{count} like these would bring {before} -> {after} mm{plan}",)


def look_up(document: ResultData, key: str | Sequence[str | int]) -> Any:
    """The value at a key such as ``fit.rms_px`` or ``dh.3.offset``, or at its parts where names have dots."""
    parts = map(str, key.split(".") if isinstance(key, str) else key)
    return reduce(lambda value, part: value[int(part)] if isinstance(value, list) else value[part], parts, document)


def to_check(calibration: FittedCalibration) -> tuple[str, ...]:
    """What the verdict wants to have checked, as others may read it: without the folders of this machine."""
    folder = calibration.session.folder
    here = f"{folder}/" if folder is not None and folder.is_absolute() else None
    reasons = calibration.assessment.reasons
    return reasons if here is None else tuple(text.replace(here, "") for text in reasons)


def fixed_parameters(document: ResultData) -> list[tuple[str, list[str]]]:
    """The parameters that were fixed for a reason not among the unidentifiable directions, reason by reason."""
    fixed: dict[str, list[str]] = {}
    for entry in document["dh"]:
        if entry["status"] == "fixed" and entry["reason"] not in document["identifiability"]["lost"]:
            fixed.setdefault(entry["reason"], []).append(f"{entry['joint']}.{entry['parameter']}")
    return list(fixed.items())


def parameter_text(document: ResultData, following: Sequence[int | None] = ()) -> str:
    """The DH rows as a table in Markdown, nominal value and offset ± standard deviation, and what was fixed and why.

    Args:
        document: the result.
        following: of joints that branch, the number of the row that each row follows.
    """
    entries: Sequence[Mapping[str, Any]] = document["dh"]
    names = list(dict.fromkeys(entry["parameter"] for entry in entries))
    columns = [f"{name} [{'mm' if name in LENGTHS else 'mrad'}]" for name in names]
    before = ["row", *(["after row"] if following else []), "joint", *columns]
    lines = [f"| {' | '.join(before)} |", f"|{'---|' * len(before)}"]
    for number, first in enumerate(range(0, len(entries), len(names)), start=1):
        row = entries[first : first + len(names)]
        carrier = [str(following[number - 1] or "")] if following else []
        lines.append(f"| {' | '.join([str(number), *carrier, row[0]['joint'], *map(_cell, row)])} |")
    identifiability, text = document["identifiability"], "\n".join(lines)
    text += f"\n\n{MOUNTS}" if any(entry["joint"].endswith(MOUNT) for entry in entries) else ""
    fixed = [f"{', '.join(which)}: {why}" for why, which in fixed_parameters(document)]
    for title, sentences in (("Unidentifiable", identifiability["lost"]), ("Not estimated", fixed)):
        if sentences:
            text += f"\n\n**{title}:**\n" + "\n".join(f"- {sentence}" for sentence in sentences)
    condition = identifiability["condition_number"]
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
        sentences.append(f"Figures of the tip are about {chain.tip_link}.")
    return tuple(sentences)


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence: one, two and three."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
