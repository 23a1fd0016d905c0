"""The result document of a fitted calibration: every number of it is read from the estimate here."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Bools, Floats, inverse
from urdfcal.estimation.blocks.arm import LENGTHS
from urdfcal.estimation.blocks.base_pose import BASE, base_keys
from urdfcal.estimation.blocks.cameras import lens_key, pose_key
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.places import PLACES
from urdfcal.estimation.blocks.planes import PLANES
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.contributions import contributions
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.estimation.model_selection import Trial
from urdfcal.estimation.observations import arrange
from urdfcal.estimation.validation import rms_interval
from urdfcal.result.document import FORMAT, ResultDocument
from urdfcal.result.error_sections import left_out_section, tip_section
from urdfcal.result.joint_model_sections import joint_model_sections
from urdfcal.robot.mechanism import BASE as BASE_LINK
from urdfcal.robot.urdf.origins import origins_of
from urdfcal.rotations import matrix_to_rpy
from urdfcal.session.moves import BASE_LINK as BASE_PART

if TYPE_CHECKING:
    from urdfcal.estimation.noise import FoundNoise
    from urdfcal.estimation.observations import Observations
    from urdfcal.result.fitted import FittedCalibration

Plain = dict[str, Any]


def build_document(of: FittedCalibration) -> ResultDocument:
    """Collect everything that a fitted calibration says."""
    data = {
        "format": FORMAT,
        "robot": _robot(of),
        "dh": _rows(of),
        "placements": _placements(of),
        "T_world_base": of.estimate.T_world_base,
        "T_world_base_sigma": of.sigmas_of(BASE),
        "leds": _leds(of),
        "targets": _targets(of),
        "cameras": {camera.name: _camera(of, c) for c, camera in enumerate(of.estimate.cameras)},
        "fit": _fit(of),
        "verdict": _of(of.assessment, "level", "sentence", "reasons"),
        "validation": _validation(of),
        **_evidence(of),
        **joint_model_sections(of),
        "joint_model_trials": [
            {
                "model": trial.term.model,
                "joints": list(trial.term.joints),
                "included": trial.included,
                "log_evidence": trial.log_evidence,
                "inside_mm": 1e3 * trial.inside,
                "elsewhere_mm": 1e3 * trial.elsewhere,
                "candidates": {
                    name: {"value": value, "sigma": sigma} for name, (value, sigma) in trial.candidates.items()
                },
            }
            for trial in of.comparison.chosen.joint_models
        ],
        "contributions": [
            {"joint": each.joint, "what": each.what, "tip_mm": 1e3 * each.tip, "sigma_mm": 1e3 * each.sigma}
            for each in contributions(of.problem, of.fit)
        ],
        "models": [
            {
                "model": str(attempt.spec),
                "parameters": attempt.fit.parameters.count,
                "seen_loss": attempt.seen_loss,
                "held_out_loss": _known(attempt.loss) if isinstance(attempt, Trial) else None,
                "chosen": attempt is of.comparison.chosen,
            }
            for attempt in of.comparison.attempts
        ],
        "identifiability": {
            "condition_number": of.identifiability.condition_number,
            **{f"O{k}": value for k, value in enumerate(of.identifiability.observability, start=1)},
            "lost": of.identifiability.unidentifiable,
        },
        "solutions": [{"cost": _known(each.cost), **_of(each, "kept", "reason")} for each in of.solutions],
        "outliers": _outliers(of),
        "warnings": of.assessment.warnings,
        "provenance": {
            "urdfcal": metadata.version("urdfcal"),
            "pinocchio": pin.__version__,
            "seed": of.seed,
            "sha256": of.session.sha256,
        },
    }
    # Keys are absent where there is nothing to say.
    parts = {
        "about": dict(of.session.about),
        "places": _places(of),
        "planes": _planes(of),
        "parameters": _parameters(of),
        "sessions": _sessions(of),
    }
    data |= {key: part for key, part in parts.items() if part}
    if excluded := of.session.excluded.named:
        data["provenance"]["excluded"] = excluded
    return ResultDocument.model_validate(_plain(data))


def _plain(value: Any) -> Any:
    """Values as JSON has them: arrays as lists, in these None where a number is not finite."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return [_plain(entry) if isinstance(entry, np.ndarray) else _known(entry.item()) for entry in value]
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def _known(value: float) -> float | None:
    """A number that may be missing: a limit, or the standard deviation of what was fixed."""
    return value if np.isfinite(value) else None


def _of(thing: object, *names: str) -> Plain:
    return {name: getattr(thing, name) for name in names}


def _noise(of: FoundNoise) -> Plain:
    apart = None if of.declared is None else float(np.sqrt(of.chi2))
    return {**_of(of, "unit", "declared", "found", "relative_sigma"), "apart": apart}


def _robot(of: FittedCalibration) -> Plain:
    chain = of.chain
    names = {BASE_LINK: None} | dict(enumerate(chain.names))
    of_joint = zip(chain.joints, chain.parents, chain.placements, of.placements, strict=True)
    return {
        **_of(chain, "name", "base_link", "tip_link"),
        "urdf": of.session.urdf_reference,
        "joints": {
            joint.name: {
                **_of(joint, "type", "axis"),
                "lower": _known(joint.lower),
                "upper": _known(joint.upper),
                "parent": names[parent],
                "mimic": joint.mimic and vars(joint.mimic),
                "nominal": nominal,
                "calibrated": calibrated,
            }
            for joint, parent, nominal, calibrated in of_joint
        },
        "tips": {tip.link: {"joint": names[tip.joint], "T_joint_link": tip.T_joint_link} for tip in chain.tips},
    }


def _rows(of: FittedCalibration) -> list[Plain]:
    sigmas, arm = of.sigmas(), of.geometry
    nominal = of.table.nominal if arm is of.table else np.zeros_like(sigmas)
    entries = []
    for (i, k), sigma in np.ndenumerate(sigmas):
        joint, name = arm.labels[i], arm.columns[k]
        entry = {
            "joint": joint,
            "parameter": name,
            "unit": "m" if name in LENGTHS else "rad",
            "nominal": nominal[i, k],
            "offset": of.estimate.offsets[i, k],
        }
        if np.isfinite(sigma):
            entry |= {"sigma": sigma, "status": "estimated"}
        else:
            reason = of.fit.parameters.reasons.get(f"{joint}.{name}") or arm.reason(i, name)
            entry |= {"status": "fixed", "reason": reason}
        entries.append(entry)
    return entries


def _placements(of: FittedCalibration) -> Plain:
    """Each joint's origin in its parent link's frame, as the URDF will have it (xyz in m, rpy in rad)."""
    origins, urdf = dict(zip(of.chain.names, of.placements, strict=True)), of.session.urdf
    if urdf is not None:
        nominal = {name: urdf.joints[name].T_parent_joint for name in of.chain.names}
        origins = nominal | origins_of(urdf, of.chain, of.placements)
    return {name: {"xyz": T[:3, 3], "rpy": matrix_to_rpy(T[:3, :3])} for name, T in origins.items()}


def _parameters(of: FittedCalibration) -> list[Plain]:
    """The coordinates of blocks that have no section of their own."""
    return [
        entry
        for block in of.fit.parameters.blocks
        for entry in block.document(of.fit.state[block.key], of.sigmas_of(block.key))
    ]


def _sessions(of: FittedCalibration) -> Plain:
    """Where each of several sessions has its base, and how well it fits; nothing of one alone."""
    session, entries = of.session, {}
    for k, (name, key) in enumerate(zip(session.parts, base_keys(session.parts), strict=True)):
        residuals: list[Plain] = []
        things = {"led": set[int](), "camera": set[int]()}
        for block, kept in zip(of.observations, of.fit.kept, strict=True):
            used = kept & (block.readings.part == k)[:, None]
            for kind in things.keys() & block.index.keys():
                things[kind].update(np.unique(block.index[kind][used]).tolist())
            if used.any():
                residuals += _residuals(of, block, used)
        entries[name or BASE_PART] = {
            "T_world_base": of.fit.state[key],
            "T_world_base_sigma": of.sigmas_of(key),
            "poses": np.count_nonzero(session.part[of.problem.poses] == k),
            "leds": [session.led_names[i] for i in sorted(things["led"])],
            "cameras": [session.rig.names[i] for i in sorted(things["camera"])],
            "residuals": residuals,
        }
    return entries if len(entries) > 1 else {}


def _residuals(of: FittedCalibration, block: Observations, used: Bools) -> list[Plain]:
    """The rms of some residuals of one kind of measurement, nominal and calibrated, in each unit that it has."""
    both = [of.problem.residual(block, solution.state)[used] for solution in (of.nominal_fit, of.fit)]
    entries = []
    for unit, scale, numbers in block.table.reports():
        nominal, calibrated = (scale * _rms(residual[:, numbers]) for residual in both)
        entries.append({"kind": block.table.kind, "unit": unit, "rms_nominal": nominal, "rms": calibrated})
    return entries


def _leds(of: FittedCalibration) -> Plain:
    attachments, sigmas = of.session.attachments, of.sigmas_of(LEDS).reshape(-1, 3)
    return {
        led.name: {
            "link": attachments.frames[attachments.led[i]],
            "position": of.estimate.leds[i],
            "sigma": np.zeros(3) if led.sigma == 0.0 else sigmas[i],
        }
        for i, led in enumerate(of.session.leds)
    }


def _places(of: FittedCalibration) -> Plain:
    sigmas = of.sigmas_of(PLACES).reshape(-1, 3)
    found = of.session.measured_names("place")
    return {name: {"position": of.fit.state[PLACES][k], "sigma": sigmas[k]} for k, name in found.items()}


def _planes(of: FittedCalibration) -> Plain:
    sigmas, entries = of.sigmas_of(PLANES).reshape(-1, 3), {}
    for k, name in of.session.measured_names("plane").items():
        plane = of.fit.state[PLANES][k]
        entries[name] = {"normal": plane[:3], "offset": plane[3], "sigma": sigmas[k]}
    return entries


def _targets(of: FittedCalibration) -> Plain:
    frames, entries = of.session.attachments, {}
    for T, (name, carrier), target in zip(of.estimate.targets, frames.carried, of.session.targets, strict=True):
        exact = target.sigma is not None and not target.sigma.any()
        sigma = np.zeros(6) if exact else of.sigmas_of(target_key(name))
        pose = {"T_link_target": T, "rpy": matrix_to_rpy(T[:3, :3])}
        entries[name] = {"link": frames.frames[carrier], **pose, "sigma": sigma}
    return entries


def _camera(of: FittedCalibration, c: int) -> Plain:
    """A camera's lens, and its pose in the world or on its link; of an arm that moved its clock's time offset."""
    camera, T, attachments = of.estimate.cameras[c], of.estimate.T_cam_frame[c], of.session.attachments
    frame = int(attachments.camera[c])
    pose = "T_link_camera" if frame else "T_cam_world"
    lens, moved = of.sigmas_of(lens_key(camera.name)), of.sigmas_of(pose_key(camera.name))
    sigma = {"intrinsics": lens[:4], "distortion": lens[4:]} if len(lens) else {}
    if len(moved):
        sigma[pose] = moved
    entry = {
        **_of(camera, "resolution", "intrinsics", "distortion_model", "distortion"),
        "link": attachments.frames[frame],
        pose: inverse(T) if frame else T,
        "sigma": sigma,
    }
    if len(of.estimate.time_offsets):
        clocks, value = of.sigmas_of(TIME_OFFSETS), of.estimate.time_offsets[c]
        entry["time_offset"] = {"value": value, "sigma": _known(clocks[c]) if len(clocks) else None}
    if of.estimate.cameras[c].rolling and len(of.estimate.time_offsets):
        line = len(of.estimate.cameras) + c
        entry["line_time"] = {"value": of.estimate.time_offsets[line], "sigma": _known(clocks[line])}
    return entry


def _fit(of: FittedCalibration) -> Plain:
    fit, rms = of.fit, {}
    found = triangulate(of.session) if of.estimate.cameras else None
    if found is not None:
        points = arrange(of.session, found)
        (space,) = _residuals(of, points, points.valid & ~of.problem.suspect(points, fit.outlier))
        rms = {"rms_nominal_mm": space["rms_nominal"], "rms_mm": space["rms"]}
    blocks = zip(of.observations, fit.kept, strict=True)
    residuals = [entry for block, kept in blocks for entry in _residuals(of, block, kept)]
    for each in residuals:
        if each["unit"] in ("px", "mm"):
            rms = {f"rms_nominal_{each['unit']}": each["rms_nominal"], f"rms_{each['unit']}": each["rms"]} | rms
    return {
        "poses": len(of.problem.poses),
        **_of(fit, "observations", "converged"),
        "parameters": fit.parameters.count,
        "rank": of.identifiability.rank,
        "iterations": len(fit.history),
        "reduced_chi2": fit.reduced_chi2 if fit.freedom > 0 else None,
        "residuals": residuals,
        **rms,
    }


def _validation(of: FittedCalibration) -> Plain:
    """Both arms with the same cameras; over measurements that are no outliers; for pixels the distance across the ray.

    Of an arm that moved the interval is of whole seconds: the errors of neighbouring frames are alike.
    """
    chosen, nominal = of.comparison.chosen, of.comparison.nominal_arm
    distance = 1e3 * chosen.residuals("distance")
    unit = of.problem.readings.unit
    low, high = rms_interval(of.observations, chosen.fit.kept, chosen.held_out.distance, unit, of.seed)
    trials = (("nominal_", nominal), ("", chosen)) if of.estimate.cameras else ()
    return {
        "folds": chosen.held_out.folds,
        "rms_nominal_mm": 1e3 * _rms(nominal.residuals("distance")[:, None]),
        "rms_mm": _rms(distance[:, None]),
        "interval_mm": [1e3 * low, 1e3 * high],
        "max_mm": distance.max(),
        "p95_mm": np.percentile(distance, 95),
        **left_out_section(of.evidence.left_out),
        **{f"rms_{prefix}px": _rms(trial.residuals("residual")[:, None]) for prefix, trial in trials},
    }


def _evidence(of: FittedCalibration) -> Plain:
    """What speaks for and against the estimate beside its residuals."""
    evidence, session = of.evidence, of.session
    regions, scale = evidence.regions, evidence.scale
    q, names = session.chain.readings(session.q), session.chain.actuated
    return {
        **({"tip": tip_section(evidence.tip)} if of.is_arm_estimated else {}),
        "regions": {
            "count": regions.count,
            "rms_nominal_mm": None if regions.rms_nominal is None else 1e3 * regions.rms_nominal,
            "rms_mm": 1e3 * regions.rms,
            "interval_mm": [_known(1e3 * end) for end in regions.interval],
        },
        "scale": {
            "tip_mm_per_permille": 1e3 * scale.tip_per_permille,
            "factor": scale.factor,
            "factor_sigma": _known(scale.sigma),
            "declared_sigma": scale.declared,
            "unit": scale.unit,
        },
        "noise": {of.name: _noise(of) for of in evidence.noise},
        "findings": [
            {
                **_of(finding, "name", "sentence", "share", "alike"),
                "pose": None if finding.pose is None else session.label(finding.pose),
            }
            for finding in evidence.findings
        ],
        "domain": {"joints": {name: [q[:, k].min(), q[:, k].max()] for k, name in enumerate(names)}},
    }


def _outliers(of: FittedCalibration) -> list[Plain]:
    """The measurements taken out of the fit: pose, camera, LED and residual (px, or mm for points)."""
    found = []
    for block, cut, norms in zip(of.observations, of.fit.outlier, of.fit.norms, strict=True):
        (_, scale, numbers), *_ = block.table.reports()
        residual = of.problem.residual(block, of.fit.state)[..., numbers]
        cameras = block.index.get("camera")
        key = "led" if "led" in block.index else "target"
        names = of.session.led_names if key == "led" else of.session.attachments.targets
        for at in map(tuple, np.argwhere(cut)):
            found.append(
                {
                    "pose": of.session.poses[block.pose[at[0]]],
                    "camera": None if cameras is None else of.estimate.cameras[cameras[at]].name,
                    "led": names[block.index[key][at]],
                    "residual": scale * np.linalg.norm(residual[at]),
                    "sigmas": norms[at],
                }
            )
    return found


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=-1)))) if residual.size else float("nan")
