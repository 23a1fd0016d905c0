"""What the recording's tabs and the report say of how to read them, as far as it depends on the calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.solver import first_solved
from urdfcal.output.findings import counted, lenses_found, listed, parameter_text
from urdfcal.output.images import find_rejected
from urdfcal.output.joint_charts import joint_model_charts
from urdfcal.output.palette import SIGMA_LEGEND
from urdfcal.output.scene import MOST_ARROWS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.output.findings import Overview
    from urdfcal.output.scene import ResidualTable
    from urdfcal.result.fitted import FittedCalibration

PART_COLORS = ("light blue", "orange", "violet")
AS_GIVEN = "with the lenses as given"
"""What the nominal arm's residuals are, where lenses were found with the arm."""
NO_DIFFERENCE = "Where the distance is below the standard deviation, no difference between the two arms is proven."
_RESIDUALS = """\
**Residuals** without what was taken out of the fit. Blue: nominal{lenses}, green: calibrated, grey: declared noise, of
{noise}.{together}

Over distance and joints: calibrated, in units of the declared noise; {parts}. Lines: means of bins, near zero where all
is noise; a trend is an effect that the model lacks.{turning}
"""
_PARAMETERS = "Corrections (bars) and their 95 % intervals; amber: tolerances, within which two in three were expected."
_WORKSPACE = f"""\
**Workspace.** Each dot is a place that the tip reaches, at joint values at random within the limits. Its colour is for
the nominal arm the distance to the calibrated one, the bases aligned; for the calibrated arm the predicted standard
deviation, sigma. All clouds have the colours of the bar, in mm. Blue: nominal, green: calibrated; amber, where there
are joint models: how far they move the tip at rest, by sagging say. {NO_DIFFERENCE}

Small dots: joint values outside of what was measured.
"""
_PIXELS = """\
White ring: where a light was detected; green dot: where the calibrated arm puts it, blue: the nominal one{lenses}.
Lines: the arm, by its joint readings alone; none where it is far beyond the image, where no lens model holds. Arrows:
residuals of all poses (at most {arrows} a camera), detected to predicted, enlarged as the title says; the white one is
as long as the number beside it. {sigmas}; blue: this pose's, of the nominal arm. Purple: taken out of the fit.
{directions}
"""
_LIGHTS = "\nOrange: lights that detection rejected; a click tells why.\n"
_CONVERGENCE = """\
**Convergence**, iteration by iteration (0: nominal). The step is in standard deviations of the estimate.
Each joint's offsets in mm and mrad; light blue: theta, dark blue: d, red: a, orange: alpha, violet: beta. Hairlines:
the estimate minus and plus one standard deviation.

{rises} Damping grows while a step does not lower the cost; a large one at the end says that rounding alone is left.

The same as time series: below `plots`, on the timeline `iteration`.
"""
_JOINTS = """\
**Joints.** What was wrong with this arm: how far each joint's geometry (blue) moves the tip{whose} over the workspace
(rms, the bases aligned), with its 95 % interval (grey). Joint by joint they may cancel.{unsure}
"""
_MODELS = """
Amber: the same of what a joint does beside. It has a chart, in mrad, or mm of a joint that slides, unless it is lost in
the scatter: blue is what the measurements show of the joint without the model, green what they show with it, grey the
model. Green should scatter about zero, blue about grey.
"""
_TURNING = "The corners of one target move together: the noise of the joint readings moves the target as a whole."


def tab_texts(overview: Overview) -> dict[str, str]:
    """How to read each tab of the recording that says so, in Markdown."""
    calibration, table = overview.calibration, overview.scene.tables[0]
    lenses = f" {AS_GIVEN}" if lenses_found(overview.document) else ""
    parts = ", ".join(f"{color}: {name}" for color, name in zip(PART_COLORS, table.components, strict=False))
    turning = f" {_TURNING}" if calibration.session.targets else ""
    residuals = _RESIDUALS.format(
        lenses=lenses, noise=noise_of(overview), together=_per_pose(table), parts=parts, turning=turning
    )
    pixels = _PIXELS.format(
        lenses=lenses, arrows=MOST_ARROWS, sigmas=SIGMA_LEGEND.capitalize(), directions=directions(overview)
    )
    return {
        "parameters": _PARAMETERS,
        "rows": parameter_text(overview.document, following(calibration)),
        "residuals": residuals,
        "pixels": pixels + (_LIGHTS if find_rejected(calibration.session) else ""),
        "convergence": _CONVERGENCE.format(rises=cost_rises(overview)),
        "joints": _JOINTS.format(whose=moved_most(overview), unsure=none_alone(overview))
        + (_MODELS if joint_model_charts(calibration) else ""),
        "workspace": _WORKSPACE,
    }


def following(calibration: FittedCalibration) -> Sequence[int | None]:
    """Of DH rows of joints that branch, the number of the row that each follows; else nothing."""
    return calibration.table.following if calibration.geometry is calibration.table else ()


def moved_most(overview: Overview) -> str:
    """Of which tip the causes of an error are counted; nothing of one arm."""
    several = len(overview.document["robot"]["tips"]) > 1
    return ", of several arms that of the one that it moves most," if several else ""


def none_alone(overview: Overview) -> str:
    """That no cause of the tip's error is beyond doubt by itself; nothing where one is."""
    found = overview.document["contributions"]
    if any(each["tip_mm"] > 1.96 * each["sigma_mm"] for each in found):
        return ""
    return " Every interval reaches 0: no cause tells by itself whether the arm was off, and by which joint."


def thinned(overview: Overview) -> str:
    """How many residuals of a camera are drawn, where it has more."""
    pixels = overview.scene.pixels
    most = 0 if pixels is None else int(np.bincount(pixels.camera[pixels.used], minlength=1).max())
    return f"; {MOST_ARROWS} of up to {most} a camera are drawn" if most > MOST_ARROWS else ""


def noise_of(overview: Overview) -> str:
    """What the declared noise is of that residuals are compared with."""
    measured = "detections" if overview.scene.tables[0].by_camera else "measurements"
    read = " and joint readings together" if overview.calibration.problem.joint_sigma > 0.0 else ""
    return f"{measured}{read}"


def together(table: ResidualTable) -> str:
    """Of which numbers a residual's length is, and how much more that is than of one; nothing where there is one."""
    count = len(table.components)
    return f"{listed(table.components)} together, √{count} times that of one" if count > 1 else ""


def _per_pose(table: ResidualTable) -> str:
    of = together(table)
    return f" By pose and camera they are of {of}." if of else ""


def directions(overview: Overview) -> str:
    """What the directions of residuals over an image tell."""
    turning = "arrows that turn together are a wrong lens or another effect that the model lacks"
    if overview.calibration.session.targets:
        return f"Arrows in random directions are noise; from target to target, {turning}. {_TURNING}"
    return f"Arrows in random directions are noise; {turning}."


def cost_rises(overview: Overview) -> str:
    """Why the cost may rise from one iteration to the next."""
    problem, of = overview.calibration.problem, "where outliers are cut and weights are renewed"
    first = first_solved(problem)
    if first is not problem:
        some, most = len(first.poses), len(problem.poses)
        of = f"where all {most} {counted(overview.document)} follow the {some} that are solved first, and {of}"
    return f"The cost may rise {of}: it is another sum then."


def unseen(overview: Overview) -> int:
    """The number of poses or frames that nothing was measured in."""
    calibration = overview.calibration
    return len(calibration.session.poses) - len(calibration.problem.poses)
