"""Joint zero offsets alone, for a controller, and the URDF that goes with a controller that has them."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.kinematics import joint_motion
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.origins import rewrite_origins

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.urdf.urdf import Urdf

FILE = "joint_offsets.csv"


def joint_offsets(calibration: Calibration, urdf: Urdf) -> dict[str, bytes]:
    """Take the joints' zero offsets out of the corrected URDF, and write them down.

    A controller in which they are entered reads ``reading + offset``; with such readings the second file moves as the
    corrected URDF does with the old ones. A joint that mimics another follows the new reading: its origin makes up
    for that.

    Args:
        calibration: the result.
        urdf: the corrected one, with the offsets in its origins.

    Returns:
        Table of offsets (rad or m) and URDF without them, by file name.

    Raises:
        OutputError: whole placements were estimated, which have no zero offsets of their own.
    """
    chain, actuated = calibration.chain, calibration.chain.actuated
    offsets = zero_offsets(calibration)
    # What every joint's value grows by when the readings do.
    growth = chain.reading_jacobian @ offsets
    origins = {
        joint.name: urdf.joints[joint.name].T_parent_joint @ joint_motion(joint, -value)
        for joint, value in zip(chain.joints, growth, strict=True)
        if value
    }
    sigmas = {(entry["joint"], entry["parameter"]): entry.get("sigma") for entry in calibration.to_dict()["dh"]}
    variables = {joint.name: "d" if joint.prismatic else "theta" for joint in chain.joints}
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["joint", "unit", "offset", "sigma"])
    for name, value in zip(actuated, offsets.tolist(), strict=True):
        sigma = sigmas.get((name, variables[name]))
        writer.writerow([name, "m" if variables[name] == "d" else "rad", value, "" if sigma is None else sigma])
    stem = urdf.path.stem if urdf.path else urdf.name
    return {FILE: table.getvalue().encode(), f"{stem}_without_offsets.urdf": rewrite_origins(urdf, origins)}


def zero_offsets(calibration: Calibration) -> Floats:
    """(k,) zero offset of each actuated joint: the real value is the reading and it. [rad or m].

    Raises:
        OutputError: whole placements were estimated.
    """
    offsets = calibration.dh_offsets
    if offsets is None:
        raise OutputError(
            "whole placements were estimated, in which no zero offset stands apart",
            remedy="Calibrate with `estimate: {geometry: dh}` or `offsets`.",
        )
    table = rows_of(calibration.chain)
    own = {table.labels[row]: offsets[row, PARAMETERS.index(name)] for row, name in table.zeros}
    return np.array([own[name] for name in calibration.chain.actuated])
