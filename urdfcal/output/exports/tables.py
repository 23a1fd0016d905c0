"""The calibrated DH rows and the joints' zero offsets as CSV, and the URDF that goes with the offsets."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.robot.kinematics import joint_motion
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.origins import rewrite_origins
from urdfcal.rotations import matrix_to_rpy

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.urdf.urdf import Urdf

ROWS, FRAMES, OFFSETS = "dh.csv", "dh_frames.csv", "joint_offsets.csv"


def dh_csv(calibration: Calibration) -> dict[str, str]:
    """Write the calibrated standard DH rows, and the constant frames before and after them.

    FK = base * prod(Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)) * tool, with q added to theta, for a prismatic joint to
    d. The rows are the nominal ones and their offsets: derived anew from the calibrated arm, common normals of almost
    parallel axes would jump.

    Args:
        calibration: the result.

    Returns:
        The rows in m and rad, each with its offset from the nominal one and its standard deviation (none where a
        parameter was fixed), and base and tool as x y z roll pitch yaw; by file name.

    Raises:
        OutputError: whole placements were estimated, which are no DH rows, or the joints branch.
    """
    offsets = calibration.dh_offsets
    if offsets is None:
        raise OutputError(
            "whole placements were estimated, which no DH rows can express",
            remedy="Calibrate with `estimate: {geometry: dh}`, or export origins: --to ros-kinematics.",
        )
    chain = calibration.chain
    if not isinstance(chain, Chain):
        raise OutputError(
            "a tree of joints is no table of DH rows",
            remedy="calibration.json has its rows; export origins: --to ros-kinematics.",
        )
    table = DHTable.from_chain(chain)
    sigmas = _sigmas(calibration)
    header = ["joint", "type", *PARAMETERS, *(f"{n}_offset" for n in PARAMETERS), *(f"{n}_sigma" for n in PARAMETERS)]
    rows = [
        [row.joint, row.type, *values, *offset, *(sigmas.get((row.joint, name), "") for name in PARAMETERS)]
        for row, values, offset in zip(
            table.rows, (table.nominal + offsets + 0.0).tolist(), offsets.tolist(), strict=True
        )
    ]
    frames = [
        [name, *(np.concatenate([T[:3, 3], matrix_to_rpy(T[:3, :3])]) + 0.0).tolist()]
        for name, T in (("base", table.base), ("tool", table.tool))
    ]
    return {ROWS: _text(header, rows), FRAMES: _text(["frame", "x", "y", "z", "roll", "pitch", "yaw"], frames)}


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
    sigmas, rows = _sigmas(calibration), []
    variables = {joint.name: "d" if joint.prismatic else "theta" for joint in chain.joints}
    for name, value in zip(actuated, offsets.tolist(), strict=True):
        unit = "m" if variables[name] == "d" else "rad"
        rows.append([name, unit, value, sigmas.get((name, variables[name]), "")])
    stem = urdf.path.stem if urdf.path else urdf.name
    return {
        OFFSETS: _text(["joint", "unit", "offset", "sigma"], rows).encode(),
        f"{stem}_without_offsets.urdf": rewrite_origins(urdf, origins),
    }


def zero_offsets(calibration: Calibration) -> Floats:
    """(k,) zero offset of each actuated joint: the real value is the reading and it. [rad or m].

    Raises:
        OutputError: whole placements were estimated.
    """
    offsets = calibration.dh_offsets
    if offsets is None:
        raise OutputError(
            "whole placements were estimated, in which zero offsets are no parameters of their own",
            remedy="Calibrate with `estimate: {geometry: dh}` or `offsets`.",
        )
    table = rows_of(calibration.chain)
    own = {table.labels[row]: offsets[row, PARAMETERS.index(name)] for row, name in table.zeros}
    return np.array([own[name] for name in calibration.chain.actuated])


def _sigmas(calibration: Calibration) -> dict[tuple[str, str], float]:
    """Standard deviations by joint and parameter, of those that were estimated."""
    return {
        (entry["joint"], entry["parameter"]): entry["sigma"]
        for entry in calibration.to_dict()["dh"]
        if entry.get("sigma") is not None
    }


def _text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
