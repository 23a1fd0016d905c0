"""The best rigid arm for a region: what a URDF can hold of an arm that bends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen, rms
from urdfcal.errors import OutputError
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.robot.box import in_box
from urdfcal.robot.kinematics import link_motions, link_poses
from urdfcal.robot.mechanism import BASE
from urdfcal.robot.placements import PlacementTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.rotations import matrix_to_rotation_vector

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.joint_models.found import FoundJointModels
    from urdfcal.result.calibration import Calibration

# A radian of orientation counts like so many metres: a tool's length, beyond which a user's point seldom is. [m]
_TOOL = 0.1
# Parameters move no further than it takes: by a tolerance [rad or m] only where the tip gains so much [m].
_TOLERANCE, _GAIN = 2e-3, 1e-5
_STEPS, _ARRIVED = 10, 1e-9
# Configurations of a region; of a box, ten times as many are drawn so often until there are enough.
_DRAWS, _ROUNDS, _LEAST = 500, 40, 20


@dataclass(frozen=True, eq=False)
class RigidFit:
    """A rigid arm, and what it loses against the full model at the configurations that it was fitted to.

    Attributes:
        placements: (n, 4, 4) of the joints. [m]
        configurations: how many.
        rms: distance of the tip links from where the full model has them, root mean square. [m]
        most: the largest distance. [m]
        angle: between their orientations, root mean square. [rad]
        rms_before: the distance for the calibration's own rigid part, as ``apply`` writes it. [m]
    """

    placements: Floats
    configurations: int
    rms: float
    most: float
    angle: float
    rms_before: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "placements", frozen(self.placements))


def best_rigid(
    calibration: Calibration,
    q: Floats,
    torques: Floats | None = None,
    previous: Floats | None = None,
    bends: FoundJointModels | None = None,
) -> RigidFit:
    """Fit the arm's geometry, without joint models, to the frames that the full model gives its tip links.

    Gauss-Newton on the parameters of the calibration's own kind, DH rows or whole placements, from its rigid part.

    Args:
        calibration: the result.
        q: (N, k) readings of the actuated joints in the region. [rad or m]
        torques: (N, k), see :meth:`Calibration.joint_values`.
        previous: (N, k) where the arm comes from.
        bends: its joint models where it carries something else than when it was calibrated, or leans otherwise.

    Raises:
        SessionError: the compliance is that under measured torques, and there are none.
    """
    chain = calibration.chain
    table: ArmParameterization
    if calibration.dh_offsets is None:
        table, offsets = (
            PlacementTable(chain.with_placements(calibration.placements)),
            no_offsets(PlacementTable(chain)),
        )
    else:
        table, offsets = rows_of(chain), calibration.dh_offsets
    tips = [tip for tip in chain.tips if tip.joint != BASE]
    true = calibration.mechanism
    values, _ = (bends or calibration.joint_models).joint_values(q, torques, previous)
    wanted = link_poses(true, values, [true.tip(tip.link) for tip in tips])
    told, rows = chain.joint_values(q), table.parameters
    at = [row for row, _ in rows], [table.columns.index(name) for _, name in rows]
    before = after = _errors(wanted, link_poses(chain, told, tips, table.placements(offsets)))
    start, fitted = offsets[at], np.array(offsets)
    # Of the mean square of what a tool's point is off by, and of the parameters where they gain nothing.
    weigh, ridge = np.repeat([1.0, _TOOL], 3) / np.sqrt(before[..., 0].size), _GAIN / _TOLERANCE
    for _ in range(_STEPS if np.any(before) else 0):
        motions = link_motions(chain, chain.build_model(table.placements(fitted)), told, tips)
        twists = table.twists(fitted, rows)
        each = [(weigh[:, None] * (motion.regressor @ twists)).reshape(-1, len(rows)) for motion in motions]
        J = np.concatenate([*each, ridge * np.eye(len(rows))])
        off = np.concatenate([(weigh * after).ravel(), ridge * (start - fitted[at])])
        step = np.asarray(np.linalg.lstsq(J, off, rcond=None)[0])
        fitted[at] += step
        after = _errors(wanted, link_poses(chain, told, tips, table.placements(fitted)))
        if np.abs(step).max() < _ARRIVED:
            break
    distance, angle = (np.linalg.norm(after[..., of], axis=-1) for of in (slice(3), slice(3, 6)))
    first = rms(np.linalg.norm(before[..., :3], axis=-1))
    placements = table.placements(fitted)
    return RigidFit(placements, len(q), rms(distance), float(distance.max(initial=0.0)), rms(angle), first)


def _errors(wanted: Sequence[Floats], found: Sequence[Floats]) -> Floats:
    """How far frames (N, 4, 4) of some links are from where they should be: (L, N, 6), linear and angular. [m, rad]."""
    T, S = np.array(wanted), np.array(found)
    turns = (T[..., :3, :3] @ np.swapaxes(S[..., :3, :3], -1, -2)).reshape(-1, 3, 3)
    angular = matrix_to_rotation_vector(turns).reshape(*T.shape[:2], 3)
    return np.concatenate([T[..., :3, 3] - S[..., :3, 3], angular], axis=-1)


def measured_domain(calibration: Calibration) -> tuple[Floats, Floats]:
    """Return the least and the largest reading (k,) of each actuated joint that was measured. [rad or m].

    Raises:
        OutputError: the result's file is of a version that did not store it.
    """
    domain = calibration.document.domain
    if domain is None:
        raise OutputError(
            "the result does not hold the measured domain",
            remedy="Name a region (--workspace), or calibrate its session again.",
        )
    lower, upper = np.array([domain.joints[name] for name in calibration.chain.actuated]).T
    return lower, upper


def draw_readings(
    calibration: Calibration, limits: tuple[Floats, Floats], box: Floats | None = None, seed: int = 0
) -> Floats:
    """Draw readings (N, k) uniformly between limits, N = 500; of a box those that take the tip into it.

    Args:
        calibration: the result.
        limits: (k,) least and largest reading of each actuated joint. [rad or m]
        box: (3, 2) least and largest x, y and z of the tip in the base link's frame; None for no box. [m]
        seed: of the draws.

    Raises:
        OutputError: the tip is hardly ever in the box.
    """
    rng, lower = np.random.default_rng(seed), limits[0]
    found, count = np.zeros((0, len(lower))), 0
    while len(found) < _DRAWS and count < _ROUNDS:
        q, count = rng.uniform(*limits, (_DRAWS if box is None else 10 * _DRAWS, len(lower))), count + 1
        if box is not None:
            q = q[in_box(calibration.calibrated, calibration.chain.joint_values(q), box)]
        found = np.concatenate([found, q])
    if len(found) < _LEAST:
        raise OutputError(
            f"the tip is in the box for {len(found)} of {10 * _DRAWS * count} configurations of the measured domain",
            where="workspace",
            remedy="Name a box that the measured poses reach, in metres in the base link's frame.",
        )
    return found[:_DRAWS]
