"""A session in, a calibrated robot out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.errors import CalibrationError, OutputError, SessionError
from urdfcal.estimation.blocks.arm import ArmBlock, no_offsets, zero_rows
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.cameras import camera_poses, has_cameras, lens_key, pose_key, without_cameras
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS, time_offsets
from urdfcal.estimation.joint_models.zero_offset import ZERO_OFFSETS
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.estimation.model_selection import Comparison, Trial, compare_models, with_fit
from urdfcal.estimation.multistart import Minimum, multistart
from urdfcal.estimation.observations import Observations, arrange
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.snapshot import Snapshot
from urdfcal.estimation.time_offset_start import start_state
from urdfcal.estimation.uncertainty import tip_covariance
from urdfcal.result.calibration import FORMAT, Calibration, corrected_name, describe
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.dh import DHTable
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.placements import PlacementTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.origins import origins_of
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rotations import matrix_to_rpy
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.identifiability import Identifiability
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.estimation.solver import Progress, Solution
    from urdfcal.estimation.state import State
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.tree_dh import TreeTable
    from urdfcal.session.model import Session

Method = Literal["pixels", "points"]

# A reduced chi-square above this is no accident with a few dozen sightings: something is unmodelled.
_MISFIT = 2.0
# Corrections of this many tolerances are either a wrong session or a very unusual arm.
_FAR = 5.0
_LENGTHS = ("d", "a", "x", "y", "z")
# FK of the URDF that was written against the estimate. [m, entries of the rotation]
_AGREEMENT = 1e-9
_CHECK_POSES = 20
_RESAMPLES = 1000


@dataclass(frozen=True, eq=False)
class FittedCalibration(Calibration):
    """A calibration with the session and the estimate it came from.

    Attributes:
        session: what was measured; of an arm that moved, joint values at the estimated time offsets.
        table: the DH rows as drawn.
        problem: the arm's parameters and the measurements, in the order that the solutions' norms follow.
        comparison: the models that were tried, and the chosen one.
        solutions: minima reached from other starts, if any were asked for; the kept one first.
        seed: of the folds and of the check configurations.
        warnings: what the user should know before trusting the result.
    """

    session: Session
    table: DHTable | TreeTable
    problem: Problem
    comparison: Comparison
    solutions: tuple[Minimum, ...]
    seed: int
    warnings: tuple[str, ...]

    @property
    def nominal_fit(self) -> Solution:
        """The arm and the lenses as given, with base, LEDs and unknown camera poses fitted."""
        return self.comparison.nominal

    @property
    def fit(self) -> Solution:
        """The chosen model's estimate."""
        return self.comparison.chosen.fit

    @property
    def identifiability(self) -> Identifiability:
        """What the sightings could not tell."""
        return self.comparison.chosen.identifiability

    @property
    def failures(self) -> tuple[str, ...]:
        """Why this result should not be used; empty when it passed its checks."""
        return self.comparison.failures

    @property
    def geometry(self) -> ArmParameterization:
        """What was estimated of the arm: the offsets of the DH rows, or of whole placements."""
        return self.problem.arm

    @property
    def observations(self) -> tuple[Observations, ...]:
        """The session's measurements, arranged by pose."""
        return self.problem.observations

    def snapshot(self, state: State) -> Snapshot:
        """The values of a state under plain names."""
        return Snapshot.of(self.problem, state)

    @cached_property
    def nominal(self) -> Snapshot:
        """The nominal arm, with everything else fitted."""
        return self.snapshot(self.nominal_fit.state)

    @cached_property
    def estimate(self) -> Snapshot:
        """The calibrated arm, LEDs and cameras."""
        return self.snapshot(self.fit.state)

    @property
    def chain(self) -> Mechanism:
        """The joints that were calibrated, as drawn."""
        return self.table.chain

    @cached_property
    def placements(self) -> Floats:
        """(n, 4, 4) calibrated placement of each joint in the frame of the one it hangs on. [m]."""
        return frozen(self.geometry.placements(self.estimate.offsets))

    def tip_sigma(self, q: Floats) -> Floats:
        """Predicted standard deviation of the calibrated tip's position, after base alignment.

        Args:
            q: (N, n) joint values. [rad or m]

        Returns:
            (N,) root of the covariance's trace. [m]
        """
        covariance = tip_covariance(self.problem, self.fit, q)
        result: Floats = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        return result

    @property
    def urdf_name(self) -> str:
        """File name of the corrected URDF."""
        return corrected_name(self.session.urdf_reference)

    def calibrated_urdf(self) -> bytes:
        """The session's URDF with the calibrated joint origins, nothing else changed.

        Raises:
            OutputError: the session has no URDF, or the result, read again by Pinocchio and by yourdfpy,
                does not move as the estimate does.
        """
        urdf = self.session.urdf
        if urdf is None:
            raise OutputError("the session was built without a URDF", remedy="Use Calibration.apply on the model.")
        data = self.apply_to_urdf(urdf)
        self._check(data)
        return data

    def to_dict(self) -> dict[str, Any]:
        """The result as plain data: the contract of ``calibration.json``."""
        from importlib import metadata

        return {
            "format": FORMAT,
            "robot": describe(self.chain, self.placements, self.session.urdf_reference),
            "dh": self._rows(),
            "placements": self._placements(),
            "T_world_base": self.estimate.T_world_base.tolist(),
            "T_world_base_sigma": _known(self._sigma[self.fit.parameters.columns(BASE)]),
            "leds": self._leds(),
            "cameras": {camera.name: self._camera(c) for c, camera in enumerate(self.estimate.cameras)},
            "fit": self.summary(),
            "validation": self.validation(),
            "models": [
                {
                    "model": str(attempt.spec),
                    "parameters": attempt.fit.parameters.count,
                    "seen_loss": attempt.seen_loss,
                    "held_out_loss": attempt.loss if isinstance(attempt, Trial) else None,
                    "chosen": attempt is self.comparison.chosen,
                }
                for attempt in self.comparison.attempts
            ],
            "identifiability": {
                "condition_number": self.identifiability.condition_number,
                **{f"O{k}": value for k, value in enumerate(self.identifiability.observability, start=1)},
                "lost": list(self.identifiability.unidentifiable),
            },
            "solutions": [
                {"cost": s.cost if np.isfinite(s.cost) else None, "kept": s.kept, "reason": s.reason}
                for s in self.solutions
            ],
            "outliers": self.outliers(),
            "warnings": [*self.failures, *self.warnings],
            "provenance": {
                "urdfcal": metadata.version("urdfcal"),
                "pinocchio": pin.__version__,
                "seed": self.seed,
                "sha256": dict(self.session.sha256),
            },
        }

    def summary(self) -> dict[str, Any]:
        """Numbers of the fit: residuals before and after, over the sightings that are no outliers. [mm, px]."""
        summary: dict[str, Any] = {
            "poses": len(self.session.poses),
            "observations": self.fit.observations,
            "parameters": self.fit.parameters.count,
            "rank": self.identifiability.rank,
            "iterations": len(self.fit.history),
            "converged": self.fit.converged,
            "reduced_chi2": self.fit.reduced_chi2 if self.fit.freedom > 0 else None,
        }
        found = triangulate(self.session) if self.estimate.cameras else None
        points = arrange(self.session, found) if found is not None else None
        for prefix, fit in (("nominal_", self.nominal_fit), ("", self.fit)):
            for block, kept in zip(self.observations, self.fit.kept, strict=True):
                unit, scale = block.table.report
                residual = self.problem.residual(block, fit.state)
                summary[f"rms_{prefix}{unit}"] = scale * _rms(residual[kept])
            if points is not None:
                residual = self.problem.residual(points, fit.state)
                suspect = self.problem.suspect(points, self.fit.outlier)
                summary[f"rms_{prefix}mm"] = 1e3 * _rms(residual[points.valid & ~suspect])
        return summary

    def validation(self) -> dict[str, Any]:
        """How well poses are predicted that the estimate has not seen, the arm as drawn and calibrated.

        Both with the same cameras; over sightings that are no outliers; for pixels the distance across the ray.
        """
        chosen, drawn = self.comparison.chosen, self.comparison.drawn
        distance = 1e3 * chosen.residuals("distance")
        result = {
            "folds": chosen.held_out.folds,
            "rms_nominal_mm": 1e3 * _rms(drawn.residuals("distance")[:, None]),
            "rms_mm": _rms(distance[:, None]),
            "interval_mm": self._held_out_interval(),
            "max_mm": float(distance.max()),
            "p95_mm": float(np.percentile(distance, 95)),
        }
        if self.estimate.cameras:
            result["rms_nominal_px"] = _rms(drawn.residuals("residual")[:, None])
            result["rms_px"] = _rms(chosen.residuals("residual")[:, None])
        return result

    def _held_out_interval(self) -> list[float]:
        """95 % interval of the held-out rms distance, in mm, by resampling whole poses (bootstrap percentiles).

        Of an arm that moved whole seconds: the errors of neighbouring frames are alike.
        """
        unit = self.session.motion.independent(len(self.session.poses))
        squares, counts = np.zeros(unit.max() + 1), np.zeros(unit.max() + 1)
        chosen = self.comparison.chosen
        for block, kept, distance in zip(self.observations, chosen.fit.kept, chosen.held_out.distance, strict=True):
            np.add.at(squares, unit[block.pose], np.sum(np.where(kept, distance, 0.0) ** 2, axis=1))
            np.add.at(counts, unit[block.pose], np.sum(kept, axis=1))
        seen = np.flatnonzero(counts)
        sample = np.random.default_rng(self.seed).choice(seen, (_RESAMPLES, len(seen)))
        rms = 1e3 * np.sqrt(squares[sample].sum(axis=1) / counts[sample].sum(axis=1))
        return [float(value) for value in np.percentile(rms, [2.5, 97.5])]

    def outliers(self) -> list[dict[str, Any]]:
        """The sightings taken out of the fit: pose, camera, LED and residual (px, or mm for points)."""
        found = []
        for block, cut, deviation in zip(self.observations, self.fit.outlier, self.fit.norms, strict=True):
            residual = self.problem.residual(block, self.fit.state)
            _, scale = block.table.report
            cameras = block.index.get("camera")
            for group, slot in np.argwhere(cut):
                found.append(
                    {
                        "pose": self.session.poses[block.pose[group]],
                        "camera": None if cameras is None else self.estimate.cameras[cameras[group, slot]].name,
                        "led": self.session.leds[block.index["led"][group, slot]].name,
                        "residual": scale * float(np.linalg.norm(residual[group, slot])),
                        "sigmas": float(deviation[group, slot]),
                    }
                )
        return found

    def sigmas(self) -> Floats:
        """Standard deviations of the estimate's offsets, in rad and m; NaN where one was not estimated."""
        result = np.full(self.estimate.offsets.shape, np.nan)
        for block in self.fit.parameters.blocks:
            sigma = self._sigma[self.fit.parameters.columns(block.key)]
            if isinstance(block, ArmBlock):
                result[block.places] = sigma
            elif block.key == ZERO_OFFSETS:
                for (row, column), value in zip(zero_rows(self.geometry).values(), sigma, strict=True):
                    result[row, column] = value
        return result

    @property
    def corrected(self) -> tuple[tuple[int, str], ...]:
        """(row, parameter) of the arm that were estimated."""
        rows, columns = np.nonzero(np.isfinite(self.sigmas()))
        return tuple((int(row), self.geometry.columns[k]) for row, k in zip(rows, columns, strict=True))

    @cached_property
    def _sigma(self) -> Floats:
        """Standard deviation of every entry of the full parameter vector; NaN where it is held."""
        return self.fit.parameters.sigmas(self.fit.covariance)

    def _rows(self) -> list[dict[str, Any]]:
        sigmas = self.sigmas()
        reasons = {name: why for block in self.fit.parameters.blocks for name, why in block.reasons.items()}
        entries = []
        drawn = self.table.nominal if self.geometry is self.table else np.zeros_like(sigmas)
        for i, joint in enumerate(self.geometry.labels):
            for k, name in enumerate(self.geometry.columns):
                entry: dict[str, Any] = {
                    "joint": joint,
                    "parameter": name,
                    "unit": "m" if name in _LENGTHS else "rad",
                    "nominal": float(drawn[i, k]),
                    "offset": float(self.estimate.offsets[i, k]),
                }
                if np.isfinite(sigmas[i, k]):
                    entry |= {"sigma": float(sigmas[i, k]), "status": "estimated"}
                else:
                    entry |= {
                        "status": "fixed",
                        "reason": reasons.get(f"{joint}.{name}") or self.geometry.reason(i, name),
                    }
                entries.append(entry)
        return entries

    def _placements(self) -> dict[str, dict[str, list[float]]]:
        """Each joint's origin in its parent link's frame, as the URDF will have it (xyz in m, rpy in rad)."""
        origins = dict(zip(self.chain.names, self.placements, strict=True))
        if self.session.urdf is not None:
            drawn = {name: self.session.urdf.joints[name].T_parent_joint for name in self.chain.names}
            origins = drawn | origins_of(self.session.urdf, self.chain, self.placements)
        return {
            name: {"xyz": T[:3, 3].tolist(), "rpy": matrix_to_rpy(T[:3, :3]).tolist()} for name, T in origins.items()
        }

    def _leds(self) -> dict[str, dict[str, Any]]:
        result = {}
        for i, led in enumerate(self.session.leds):
            sigma = self._sigma[self.fit.parameters.columns(LEDS)][3 * i : 3 * i + 3]
            result[led.name] = {
                "link": self.session.attachments.frames[self.session.attachments.led[i]],
                "position": self.estimate.leds[i].tolist(),
                "sigma": [float(s) if np.isfinite(s) else 0.0 if led.sigma == 0.0 else None for s in sigma],
            }
        return result

    def _camera(self, c: int) -> dict[str, Any]:
        """A camera's lens, and where it is: in the world, or on the link that it rides on."""
        camera, T, frames = self.estimate.cameras[c], self.estimate.T_cam_frame[c], self.session.attachments
        frame = int(frames.camera[c])
        place = {"T_cam_world": T.tolist()} if frame == 0 else {"T_link_camera": inverse(T).tolist()}
        return {
            "intrinsics": camera.intrinsics.tolist(),
            "distortion_model": camera.distortion_model,
            "distortion": camera.distortion.tolist(),
            "link": frames.frames[frame],
            **place,
            "sigma": self._camera_sigma(c, next(iter(place))),
            **self._clock(c),
        }

    def _clock(self, c: int) -> dict[str, Any]:
        """Of an arm that moved, the time offset of a camera's clock in s, t_robot = t_camera + offset."""
        if not len(self.estimate.time_offsets):
            return {}
        sigmas = self._sigma[self.fit.parameters.columns(TIME_OFFSETS)]
        sigma = sigmas[c] if len(sigmas) else np.nan
        known = float(sigma) if np.isfinite(sigma) else None
        return {"time_offset": {"value": float(self.estimate.time_offsets[c]), "sigma": known}}

    def _camera_sigma(self, c: int, place: str) -> dict[str, list[float | None]]:
        """Standard deviations of what was estimated of a camera; its place's of a small motion in its own frame."""
        parameters, name, result = self.fit.parameters, self.estimate.cameras[c].name, {}
        lens, pose = (self._sigma[parameters.columns(key)] for key in (lens_key(name), pose_key(name)))
        if len(lens):
            result = {"intrinsics": lens[:4], "distortion": lens[4:]}
        if len(pose):
            result[place] = pose
        return {key: _known(values) for key, values in result.items()}

    def _check(self, data: bytes) -> None:
        """Read the URDF again with two independent readers and compare their FK with the DH rows."""
        rng = np.random.default_rng(self.seed)
        q = self.chain.random_values(_CHECK_POSES, rng)
        links = [tip.link for tip in self.chain.tips]
        expected = np.array(link_poses(self.chain, q, self.chain.tips, self.placements))
        again = read_mechanism(Urdf.parse(data), links, self.chain.base_link)
        tips = {
            "Pinocchio": np.array(link_poses(again, q, again.tips)),
            "yourdfpy": _yourdfpy_links(data, self.chain, q),
        }
        if self.geometry is self.table and isinstance(self.table, DHTable):
            tips["the DH rows"] = np.array([[self.table.forward(q_k, self.estimate.offsets) for q_k in q]])
        for reader, T in tips.items():
            error = float(np.abs(T - expected).max())
            if not error <= _AGREEMENT:
                raise OutputError(
                    f"the corrected URDF moves differently when read by {reader}: {error:.1e} m or in the rotation",
                    where=self.session.urdf_reference,
                    remedy="This is a defect of urdfcal; please report it with the URDF.",
                )


def calibrate(
    session: Session,
    *,
    method: Method = "pixels",
    priors: bool = True,
    starts: int = 0,
    seed: int = 0,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedCalibration:
    """Estimate the robot that was really built from a session.

    Maximum likelihood on pixels (or a tracker's points), whitened by the declared noise of sightings and joint
    readings, with manufacturing tolerances as priors; robust against outliers (Rossi, Savino et al., eq. 8 and 22).
    The start is found in closed form. Where the session does not say what to estimate, the model that predicts poses
    best that it has not seen is chosen. Parameters that the sightings cannot tell are held at nominal.

    Args:
        session: what was measured.
        method: whether the cameras' pixels count, or the points triangulated from them with their covariances.
        priors: whether manufacturing and LED tolerances act as priors; without, plain least squares (the seed's eq. 8).
        starts: how many other arms to start from, near the drawing and far from it; what they lead to is screened.
        seed: of the division into folds, of other starts, and of the configurations at which the result is checked.
        force: give the result even where it fails its own checks; ``Calibration.failures`` says which.
        progress: called after every solver step.

    Raises:
        CalibrationError: there is no start, or the result fails its checks: no convergence, no better than the drawn
            arm on poses not seen, or lenses that the sightings refute.
    """
    table = rows_of(session.chain)
    arm: ArmParameterization = PlacementTable(session.chain) if session.estimate.geometry == "full" else table
    problem = Problem.of(session, arm)
    in_world = [of.table.kind for of in problem.observations if of.table.defines_world(session.attachments)]
    if len(in_world) > 1:
        raise SessionError(
            f"{' and '.join(in_world)} are both named: the tracker's frame is not the first camera's",
            remedy="Name one of them; evaluate --points checks a result against the other.",
        )
    start = start_state(session, arm, no_offsets(arm))
    recorded = session.recorded(time_offsets(start))
    if recorded is not session:
        session, problem = recorded, Problem.of(recorded, arm)
    if method == "points":
        problem, start = Problem.of(session, arm, [_as_points(session)]), without_cameras(start)
    comparison = compare_models(session, problem, start, priors=priors, seed=seed, progress=progress)
    solutions: tuple[Minimum, ...] = ()
    if starts:
        fit = comparison.chosen.fit
        solutions = multistart(session, problem, fit, starts, seed, progress)
        kept = solutions[0].solution if solutions[0].kept else None
        if kept is not None and kept is not fit:
            comparison = with_fit(comparison, kept, session, problem, seed)
    if comparison.failures and not force:
        raise CalibrationError(
            "; ".join(comparison.failures), where="not written", remedy="--force writes it all the same."
        )
    return FittedCalibration(
        session=session.with_time_offsets(time_offsets(comparison.chosen.fit.state)),
        table=table,
        problem=problem,
        comparison=comparison,
        solutions=solutions,
        seed=seed,
        warnings=(*session.warnings, *_doubts(comparison.chosen.fit), *_strange_mounts(session, comparison.chosen.fit)),
    )


def _as_points(session: Session) -> Measurement:
    if isinstance(session.motion, Trajectory):
        raise CalibrationError(
            "no point can be triangulated: every frame is taken by one camera, at a time of its own",
            remedy="Leave --method points out.",
        )
    points = triangulate(session)
    if points is None:
        raise CalibrationError(
            "no point can be triangulated from these sightings",
            remedy="It takes two cameras of known pose; a tracker's points.csv needs no --method points.",
        )
    return points


def _doubts(fit: Solution) -> list[str]:
    """What in a fit a careful engineer would ask about."""
    doubts = []
    if fit.reduced_chi2 > _MISFIT:
        doubts.append(
            f"the residuals are {np.sqrt(fit.reduced_chi2):.1f} times the declared noise: the noise is larger than "
            "declared, or camera intrinsics, units or the robot's stiffness are not what the model assumes"
        )
    for block in fit.parameters.blocks:
        if not block.toleranced:
            continue
        offsets, _ = block.local(fit.state[block.key])
        for k in np.flatnonzero(block.active & (np.abs(offsets) > _FAR * block.sigma)):
            doubts.append(
                f"{block.names[k]} is off by {1e3 * offsets[k]:.1f} {'mm' if block.units[k] == 'm' else 'mrad'}, "
                f"{abs(offsets[k]) / block.sigma[k]:.0f} times its tolerance"
            )
    return doubts


def _strange_mounts(session: Session, fit: Solution) -> list[str]:
    """Cameras that sit far from where the session puts them on their links."""
    doubts = []
    for mount in session.mounts:
        if mount.T_link_camera is None or mount.sigma is None or not has_cameras(fit.state):
            continue
        T = camera_poses(session.attachments, fit.state)[session.rig.index(mount.camera)] @ mount.T_link_camera
        motion = pin.log6(T).vector
        if np.abs(motion / mount.sigma).max() > _FAR:
            doubts.append(
                f"camera {mount.camera!r} comes out {1e3 * np.linalg.norm(motion[:3]):.0f} mm and "
                f"{1e3 * np.linalg.norm(motion[3:]):.0f} mrad from where the session puts it on {mount.link!r}, "
                f"{np.abs(motion / mount.sigma).max():.0f} times its sigma: check position, rpy (rad) and link"
            )
    return doubts


def _known(sigmas: Floats) -> list[float | None]:
    """Standard deviations, None where a value was held."""
    return [float(s) if np.isfinite(s) else None for s in sigmas]


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=-1)))) if residual.size else float("nan")


def _yourdfpy_links(data: bytes, chain: Mechanism, q: Floats) -> Floats:
    """T_base_link (tips, N, 4, 4) by yourdfpy, which shares no code with Pinocchio."""
    import io

    import yourdfpy

    robot = yourdfpy.URDF.load(io.BytesIO(data), load_meshes=False, build_scene_graph=True)
    for joint in robot.joint_map.values():  # it takes a sliding joint's axis as long as it is written
        if joint.axis is not None and np.any(joint.axis):
            joint.axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    names = [joint.name for joint in robot.actuated_joints]
    result = np.empty((len(chain.tips), len(q), 4, 4))
    for k, q_k in enumerate(q):
        values = dict(zip(chain.names, q_k, strict=True))
        robot.update_cfg([values.get(name, 0.0) for name in names])
        for i, tip in enumerate(chain.tips):
            result[i, k] = robot.get_transform(tip.link, chain.base_link)
    return result
