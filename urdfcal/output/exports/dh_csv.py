"""The calibrated DH rows as CSV, for whatever reads tables."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.rotations import matrix_to_rpy

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.result.calibration import Calibration

ROWS, FRAMES = "dh.csv", "dh_frames.csv"


def dh_csv(calibration: Calibration) -> dict[str, str]:
    """Write the calibrated standard DH rows, and the constant frames before and after them.

    FK = base * prod(Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)) * tool, with q added to theta, for a prismatic joint to
    d. The rows are the drawn ones and their offsets: derived anew from the calibrated arm, common normals of almost
    parallel axes would jump.

    Args:
        calibration: the result.

    Returns:
        The rows in m and rad, each with its offset from the drawing and its standard deviation (none where a
        parameter was held), and base and tool as x y z roll pitch yaw; by file name.

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
    sigmas = {
        (entry["joint"], entry["parameter"]): entry["sigma"]
        for entry in calibration.to_dict()["dh"]
        if entry.get("sigma") is not None
    }
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


def _text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
