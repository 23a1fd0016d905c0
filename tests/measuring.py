"""More poses measured on a simulated arm."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import rms
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.measurements import Detections
from urdfcal.session.model import MIN_POSES, Positions
from urdfcal.simulation.joint_errors import true_joint_values
from urdfcal.simulation.scene import noisy_values, simulate_detections

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.result.calibration import Calibration
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated


def measured_too(session: Session, simulated: Simulated, q: Floats, seed: int) -> Session:
    """A session, and its true arm measured in more poses ``q`` (N, n), as few as there are."""
    count, enough = len(q), np.arange(max(len(q), MIN_POSES)) % len(q)
    return both(session, measured_at(simulated, q[enough], seed), count)


def measured_at(simulated: Simulated, q: Floats, seed: int) -> Session:
    """The true arm of a simulation measured in poses of its nominal readings ``q`` (N, n)."""
    truth, session = simulated.truth, simulated.session
    joint_rng, noise_rng = np.random.default_rng((seed, 11)).spawn(2)
    planned = Positions(**session.of_setup(), poses=tuple(f"more {seed}.{k}" for k in range(len(q))), q=q)
    views = np.tile(np.arange(len(truth.cameras)), (len(q), 1))
    noise = truth.pixel, session.noise.of(Detections)
    true = true_joint_values(planned, truth.joint_errors)
    detections, _ = simulate_detections(truth, true, views, noise, 0.0, noise_rng, noise_rng)
    return planned.measured((detections,), q=noisy_values(session, planned.q, joint_rng))


def both(a: Session, b: Session, count: int | None = None) -> Session:
    """The poses of two sessions of one setup, one after the other; of the second its first ``count``."""
    first, second = (of.find(Detections) for of in (a, b))
    count = len(b.poses) if count is None else count
    second = second.rows(second.pose < count)
    columns = {key: np.concatenate([column, second.index[key]]) for key, column in first.index.items()}
    columns["pose"] = np.concatenate([first.pose, second.pose + len(a.poses)])
    uv, sigma = (np.concatenate([getattr(of, name) for of in (first, second)]) for name in ("uv", "sigma"))
    detections = Detections(**columns, uv=uv, sigma=sigma)
    q = np.concatenate([a.q, b.q[:count]])
    poses = (*a.poses, *b.poses[:count])
    return replace(a, poses=poses, q=q, previous=None, part=np.zeros(len(q)), measurements=(detections,))


def true_error(simulated: Simulated, calibration: Calibration, count: int = 500) -> float:
    """How far the calibrated tip is off over the workspace, rms, the base aligned. [m]."""
    nominal = simulated.session.chain
    true = nominal.with_placements(simulated.truth.placements)
    q = nominal.random_values(count, np.random.default_rng(0))
    return rms(compare(nominal.with_placements(calibration.placements), true, q).position)
