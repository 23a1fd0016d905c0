"""The truth behind a simulated session, written where a person or a benchmark reads it and calibration never does."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.estimation.measurements import Detections
from urdfcal.files import write_bytes, write_text
from urdfcal.io.writing import write_session
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.tree_dh import rows_of
from urdfcal.simulation.scene import Scene

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.session.model import Session

_URDF, _JSON = "truth.urdf", "truth.json"


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth(Scene):
    """The true robot and cameras behind a simulated session, which calibration never reads, and how they were drawn.

    Attributes:
        seed: of all that is random.
        pixel: noise of the detections, one standard deviation. [px]
        error_scale: factor on the offsets.
        outlier_share: of the detections, as asked for.
        offsets: (n, 5) of the DH rows, columns as ``PARAMETERS``. [rad, m]
        q: (N, n) joint values. [rad or m]
        outliers: (K,) rows of the session's detections that are outliers.
        urdf: the true robot's description: the nominal one with other ``<origin>`` values.
        time_offsets: (C,) of the cameras' clocks, t_robot = t_camera + offset; empty where the arm stood still. [s]
    """

    seed: int
    pixel: float
    error_scale: float
    outlier_share: float
    offsets: Floats
    q: Floats
    outliers: Ints
    urdf: bytes
    time_offsets: Floats = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class Simulated:
    """A session and the truth behind it.

    Attributes:
        session: as measured; its ``warnings`` say what could not be checked.
        truth: what it was measured on.
    """

    session: Session
    truth: Truth


def write_simulated(folder: str | Path, simulated: Simulated, *, detections: bool = True) -> None:
    """Write a session, and beside it what no calibration reads: truth.urdf and truth.json.

    Args:
        folder: where to; made if need be, in a folder that exists.
        simulated: what to write.
        detections: whether to write them too; without, the session waits for images.

    Raises:
        OutputError: the folder holds a session or a truth already, or cannot be written.
    """
    folder, session = Path(folder), simulated.session
    for name in (_URDF, _JSON):
        if (folder / name).exists():
            raise OutputError(f"there is a {name} already", where=str(folder), remedy="Name a new folder.")
    if Path(session.urdf_reference).name == _URDF:
        raise OutputError(f"the nominal robot's file is itself called {_URDF}", where=str(folder), remedy="Rename it.")
    write_session(folder, session if detections else session.unmeasured())
    write_bytes(folder / _URDF, simulated.truth.urdf)
    write_text(folder / _JSON, json.dumps(_truth_to_dict(simulated), indent=1) + "\n")


def _truth_to_dict(simulated: Simulated) -> dict[str, Any]:
    session, truth = simulated.session, simulated.truth
    table, cameras, leds = rows_of(session.chain), session.rig.names, session.led_names
    offsets = dict(zip(cameras, truth.time_offsets.tolist(), strict=False))
    detections = session.find(Detections)
    return {
        "seed": truth.seed,
        "poses": len(session.poses),
        "error_scale": truth.error_scale,
        "outlier_share": truth.outlier_share,
        "noise": {"pixel": truth.pixel, "joint": session.noise.joint},
        "dh": [
            {
                "joint": label,
                "parameter": name,
                "unit": "m" if name in ("d", "a") else "rad",
                "nominal": value + 0.0,  # no "-0.0"
                "offset": float(offset),
            }
            for label, row, row_offsets in zip(table.labels, table.nominal.tolist(), truth.offsets, strict=True)
            for name, value, offset in zip(PARAMETERS, row, row_offsets, strict=True)
        ],
        "T_world_base": truth.T_world_base.tolist(),
        "leds": dict(zip(leds, truth.leds.tolist(), strict=True)),
        "T_cam_frame": dict(zip(cameras, truth.T_cam_frame.tolist(), strict=True)),
        **({"time_offsets": offsets} if offsets else {}),
        "outliers": [
            {
                "pose": session.label(int(detections.pose[row])),
                "camera": cameras[detections.camera[row]],
                "led": leds[detections.led[row]],
            }
            for row in truth.outliers
            if detections is not None
        ],
    }
