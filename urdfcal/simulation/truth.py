"""The truth behind a simulated session, which calibration never reads."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import frozen
from urdfcal.estimation.measurements import Detections
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.tree_dh import rows_of
from urdfcal.simulation.joint_errors import joint_errors_to_dicts
from urdfcal.simulation.scene import Scene

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.session.model import Session
    from urdfcal.simulation.moving import Moving
    from urdfcal.simulation.true_prints import TruePrint


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth(Scene):
    """The true robot and cameras behind a simulated session, which calibration never reads, and how they were drawn.

    Attributes:
        seed: of all that is random.
        arm_seed: of the robot alone.
        pixel: noise of the detections, one standard deviation. [px]
        error_scale: factor on the offsets.
        outlier_share: of the detections, as asked for.
        offsets: (n, 5) of the DH rows, columns as ``PARAMETERS``. [rad, m]
        q: (N, n) joint values, of flexures too where links bend. [rad or m]
        readings: (N, n) what perfect encoders say of them; of an arm that moves, in the poses that it moves through.
            [rad or m]
        joint_errors: parameters (k,) of the joint models that lie between, by name.
        outliers: (K,) rows of the session's detections that are outliers.
        urdf: the true robot's description: the nominal one with other ``<origin>`` values.
        prints: of each target.
        time_offsets: (C,) of the cameras' clocks, t_robot = t_camera + offset; empty where the arm stood still. [s]
        places: (3,) of each place that was touched, in the base link's frame. [m]
        moving: how the arm moved, if it did.
    """

    seed: int
    arm_seed: int
    pixel: float
    error_scale: float
    outlier_share: float
    offsets: Floats
    q: Floats
    readings: Floats
    joint_errors: Mapping[str, Floats]
    outliers: Ints
    urdf: bytes
    prints: tuple[TruePrint, ...] = ()
    time_offsets: Floats = field(default_factory=lambda: np.zeros(0))
    places: Mapping[str, Floats] = field(default_factory=dict)
    moving: Moving | None = None

    @property
    def rolling(self) -> Moving | None:
        """How the arm moved before a camera that takes row after row; None where none does, or it did not."""
        return self.moving if any(camera.rolling for camera in self.cameras) else None


@dataclass(frozen=True, eq=False)
class Simulated:
    """A session and the truth behind it.

    Attributes:
        session: as measured; its ``warnings`` say what could not be checked.
        truth: what it was measured on.
    """

    session: Session
    truth: Truth

    def unmeasured_at(self, poses: Sequence[int]) -> Simulated:
        """Return it without what was measured in some poses: the arm was there, and nothing more."""
        (table,) = self.session.measurements
        kept = ~np.isin(table.index["pose"], poses)
        outliers = np.flatnonzero(np.isin(np.flatnonzero(kept), self.truth.outliers))
        session = replace(self.session, measurements=(table.rows(kept),))
        return Simulated(session, replace(self.truth, outliers=frozen(outliers, np.intp)))


def truth_to_dict(simulated: Simulated) -> dict[str, Any]:
    """Return the truth behind a session as plain data: what ``truth.json`` holds."""
    session, truth = simulated.session, simulated.truth
    table, cameras, leds = rows_of(session.chain), session.rig.names, session.led_names
    targets = [target.name for target in session.targets]
    offsets = dict(zip(cameras, truth.time_offsets.tolist(), strict=False))
    lines = {camera.name: camera.line_time for camera in truth.cameras if camera.rolling and offsets}
    detections = session.find(Detections)
    places = {name: place.tolist() for name, place in truth.places.items()}
    prints = {name: of.to_dict() for name, of in zip(targets, truth.prints, strict=True) if not of.as_given}
    return {
        "seed": truth.seed,
        "arm_seed": truth.arm_seed,
        "poses": len(session.poses),
        "error_scale": truth.error_scale,
        "outlier_share": truth.outlier_share,
        "noise": {"pixel": truth.pixel, "joint": session.noise.reading},
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
        "leds": dict(zip(leds[: truth.led_count], truth.leds.tolist(), strict=False)),
        **({"targets": dict(zip(targets, truth.targets.tolist(), strict=True))} if targets else {}),
        **({"prints": prints} if prints else {}),
        "T_cam_frame": dict(zip(cameras, truth.T_cam_frame.tolist(), strict=True)),
        **({"time_offsets": offsets} if offsets else {}),
        **({"line_times": lines} if lines else {}),
        **({"places": places} if places else {}),
        **({"joint_errors": joint_errors_to_dicts(session, truth.joint_errors)} if truth.joint_errors else {}),
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
