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

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.session.model import Session

_URDF, _JSON = "truth.urdf", "truth.json"


@dataclass(frozen=True, eq=False)
class Truth:
    """What calibration is to find out, and is never told.

    Attributes:
        seed: of all that is random.
        pixel: noise of the sightings, one standard deviation. [px]
        error_scale: factor on the offsets.
        outlier_share: of the sightings, asked for.
        offsets: (n, 5) of the DH rows, columns as ``PARAMETERS``. [rad, m]
        placements: (n, 4, 4) of the joints. [m]
        T_world_base: (4, 4) where the arm stands; the world is the first camera's frame. [m]
        leds: (L, 3) in the frames of what they are fastened to. [m]
        T_cam_frame: (C, 4, 4) in each camera the frame that it is fixed in: the world, or the link it rides on. [m]
        q: (N, n) joint values. [rad or m]
        outliers: (K,) rows of the session's detections that are none of the LED.
        urdf: the true robot's description: the drawn one with other ``<origin>`` values.
        time_offsets: (C,) of the cameras' clocks, t_robot = t_camera + offset; empty where the arm stood still. [s]
    """

    seed: int
    pixel: float
    error_scale: float
    outlier_share: float
    offsets: Floats
    placements: Floats
    T_world_base: Floats
    leds: Floats
    T_cam_frame: Floats
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


def write_simulated(folder: str | Path, simulated: Simulated, *, sightings: bool = True) -> None:
    """Write a session, and beside it what no calibration reads: truth.urdf and truth.json.

    Args:
        folder: where to; made if need be, in a folder that exists.
        simulated: what to write.
        sightings: whether to write them too; without, the session waits for images.

    Raises:
        OutputError: the folder holds a session or a truth already, or cannot be written.
    """
    folder, session = Path(folder), simulated.session
    for name in (_URDF, _JSON):
        if (folder / name).exists():
            raise OutputError(f"there is a {name} already", where=str(folder), remedy="Name a new folder.")
    if Path(session.urdf_reference).name == _URDF:
        raise OutputError(f"the drawn robot's file is itself called {_URDF}", where=str(folder), remedy="Rename it.")
    write_session(folder, session if sightings else session.unmeasured())
    write_bytes(folder / _URDF, simulated.truth.urdf)
    write_text(folder / _JSON, json.dumps(_truth_to_dict(simulated), indent=1) + "\n")


def _truth_to_dict(simulated: Simulated) -> dict[str, Any]:
    session, truth = simulated.session, simulated.truth
    table = rows_of(session.chain)
    seen = session.find(Detections)
    names = session.rig.names
    clocks = dict(zip(names, truth.time_offsets.tolist(), strict=False))
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
        "leds": dict(zip(session.led_names, truth.leds.tolist(), strict=True)),
        "T_cam_frame": dict(zip(session.rig.names if session.rig else (), truth.T_cam_frame.tolist(), strict=True)),
        **({"time_offsets": clocks} if clocks else {}),
        "outliers": [
            {
                "pose": session.label(int(seen.pose[row])),
                "camera": session.rig.names[seen.camera[row]],
                "led": session.led_names[seen.led[row]],
            }
            for row in truth.outliers
            if seen is not None
        ],
    }
