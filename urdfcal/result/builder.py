"""The result document of a fitted calibration: every number of it is read from the estimate here."""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.arm import LENGTHS
from urdfcal.estimation.blocks.base_pose import BASE, base_keys
from urdfcal.estimation.blocks.cameras import lens_key, pose_key
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.places import PLACES
from urdfcal.estimation.blocks.planes import PLANES
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.estimation.model_selection import Trial
from urdfcal.estimation.observations import arrange
from urdfcal.estimation.validation import rms_interval
from urdfcal.result import document as d
from urdfcal.result import evidence_sections as e
from urdfcal.robot.mechanism import BASE as BASE_LINK
from urdfcal.robot.urdf.origins import origins_of
from urdfcal.rotations import matrix_to_rpy
from urdfcal.session.moves import BASE_LINK as BASE_PART

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.robot.mechanism import Mechanism


def build_document(of: FittedCalibration) -> d.ResultDocument:
    """Collect everything that a fitted calibration says."""
    parameters = _parameters(of)
    parts = {"places": _places(of), "planes": _planes(of), "parameters": parameters}
    listed: dict[str, Any] = {key: part for key, part in parts.items() if part}  # absent where there are none
    named = of.session.excluded.named
    excluded: dict[str, Any] = {"excluded": named} if named else {}
    return d.ResultDocument(
        format=d.FORMAT,
        robot=_robot(of.chain, of.placements, of.session.urdf_reference),
        dh=_rows(of),
        placements=_placements(of),
        T_world_base=of.estimate.T_world_base.tolist(),
        T_world_base_sigma=_known(of.sigmas_of(BASE)),
        **_sessions(of),
        leds=_leds(of),
        targets=_targets(of),
        cameras={camera.name: _camera(of, c) for c, camera in enumerate(of.estimate.cameras)},
        **listed,
        fit=_fit(of),
        verdict=d.VerdictSection(
            level=of.assessment.level, sentence=of.assessment.sentence, reasons=list(of.assessment.reasons)
        ),
        validation=_validation(of),
        **_evidence(of),
        models=[
            d.ModelEntry(
                model=str(attempt.spec),
                parameters=attempt.fit.parameters.count,
                seen_loss=attempt.seen_loss,
                held_out_loss=attempt.loss if isinstance(attempt, Trial) and np.isfinite(attempt.loss) else None,
                chosen=attempt is of.comparison.chosen,
            )
            for attempt in of.comparison.attempts
        ],
        identifiability=d.IdentifiabilitySection(
            condition_number=of.identifiability.condition_number,
            **{f"O{k}": value for k, value in enumerate(of.identifiability.observability, start=1)},
            lost=list(of.identifiability.unidentifiable),
        ),
        solutions=[
            d.SolutionEntry(cost=s.cost if np.isfinite(s.cost) else None, kept=s.kept, reason=s.reason)
            for s in of.solutions
        ],
        outliers=_outliers(of),
        warnings=list(of.assessment.warnings),
        provenance=d.ProvenanceSection(
            urdfcal=metadata.version("urdfcal"),
            pinocchio=pin.__version__,
            seed=of.seed,
            sha256=dict(of.session.sha256),
            **excluded,
        ),
    )


def _robot(chain: Mechanism, placements: Floats, urdf_reference: str) -> d.RobotSection:
    joints = {}
    for joint, parent, nominal, calibrated in zip(
        chain.joints, chain.parents, chain.placements, placements, strict=True
    ):
        mimic = joint.mimic
        joints[joint.name] = d.JointEntry(
            parent=None if parent == BASE_LINK else chain.names[parent],
            type=joint.type,
            axis=joint.axis.tolist(),
            lower=joint.lower if np.isfinite(joint.lower) else None,
            upper=joint.upper if np.isfinite(joint.upper) else None,
            mimic=None
            if mimic is None
            else d.MimicEntry(joint=mimic.joint, multiplier=mimic.multiplier, offset=mimic.offset),
            nominal=nominal.tolist(),
            calibrated=calibrated.tolist(),
        )
    tips = {
        tip.link: d.TipEntry(
            joint=None if tip.joint == BASE_LINK else chain.names[tip.joint], T_joint_link=tip.T_joint_link.tolist()
        )
        for tip in chain.tips
    }
    return d.RobotSection(
        name=chain.name,
        urdf=urdf_reference,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        joints=joints,
        tips=tips,
    )


def _rows(of: FittedCalibration) -> list[d.DHEntry]:
    sigmas, arm = of.sigmas(), of.geometry
    reasons = of.fit.parameters.reasons
    nominal = of.table.nominal if arm is of.table else np.zeros_like(sigmas)
    entries = []
    for i, joint in enumerate(arm.labels):
        for k, name in enumerate(arm.columns):
            estimated = bool(np.isfinite(sigmas[i, k]))
            more: dict[str, Any] = (
                {"sigma": float(sigmas[i, k]), "status": "estimated"}
                if estimated
                else {"status": "fixed", "reason": reasons.get(f"{joint}.{name}") or arm.reason(i, name)}
            )
            entries.append(
                d.DHEntry(
                    joint=joint,
                    parameter=name,
                    unit="m" if name in LENGTHS else "rad",
                    nominal=float(nominal[i, k]),
                    offset=float(of.estimate.offsets[i, k]),
                    **more,
                )
            )
    return entries


def _placements(of: FittedCalibration) -> dict[str, d.OriginEntry]:
    """Each joint's origin in its parent link's frame, as the URDF will have it (xyz in m, rpy in rad)."""
    origins, urdf = dict(zip(of.chain.names, of.placements, strict=True)), of.session.urdf
    if urdf is not None:
        nominal = {name: urdf.joints[name].T_parent_joint for name in of.chain.names}
        origins = nominal | origins_of(urdf, of.chain, of.placements)
    return {
        name: d.OriginEntry(xyz=T[:3, 3].tolist(), rpy=matrix_to_rpy(T[:3, :3]).tolist()) for name, T in origins.items()
    }


def _parameters(of: FittedCalibration) -> list[d.ParameterEntry]:
    """The coordinates of blocks that have no section of their own."""
    return [
        d.ParameterEntry(**entry)
        for block in of.fit.parameters.blocks
        for entry in block.document(of.fit.state[block.key], of.sigmas_of(block.key))
    ]


def _sessions(of: FittedCalibration) -> dict[str, Any]:
    """Where each of several sessions has its base, and how well it fits; absent of one alone."""
    session, entries = of.session, {}
    for k, (name, key) in enumerate(zip(session.parts, base_keys(session.parts), strict=True)):
        residuals: list[d.ResidualEntry] = []
        things = {"led": set[int](), "camera": set[int]()}
        for block, kept in zip(of.observations, of.fit.kept, strict=True):
            used = kept & (block.readings.part == k)[:, None]
            for kind in things.keys() & block.index.keys():
                things[kind].update(np.unique(block.index[kind][used]).tolist())
            if used.any():
                residuals += _residuals(of, block, used)
        entries[name or BASE_PART] = d.SessionEntry(
            T_world_base=of.fit.state[key].tolist(),
            T_world_base_sigma=_known(of.sigmas_of(key)),
            poses=int(np.count_nonzero(session.part[of.problem.poses] == k)),
            leds=[session.led_names[i] for i in sorted(things["led"])],
            cameras=[session.rig.names[i] for i in sorted(things["camera"])],
            residuals=residuals,
        )
    return {"sessions": entries} if len(entries) > 1 else {}


def _residuals(of: FittedCalibration, block: Observations, used: Bools) -> Iterator[d.ResidualEntry]:
    """The rms of some residuals of one kind of measurement, nominal and calibrated, in each unit that it has."""
    both = [of.problem.residual(block, state)[used] for state in (of.nominal_fit.state, of.fit.state)]
    for unit, scale, numbers in block.table.reports():
        nominal, calibrated = (scale * _rms(residual[:, numbers]) for residual in both)
        yield d.ResidualEntry(kind=block.table.kind, unit=unit, rms_nominal=nominal, rms=calibrated)


def _leds(of: FittedCalibration) -> dict[str, d.LedEntry]:
    result, attachments, sigmas = {}, of.session.attachments, of.sigmas_of(LEDS).reshape(-1, 3)
    for i, led in enumerate(of.session.leds):
        result[led.name] = d.LedEntry(
            link=attachments.frames[attachments.led[i]],
            position=of.estimate.leds[i].tolist(),
            sigma=[0.0, 0.0, 0.0] if led.sigma == 0.0 else _known(sigmas[i]),
        )
    return result


def _places(of: FittedCalibration) -> dict[str, d.PlaceEntry]:
    sigmas = of.sigmas_of(PLACES).reshape(-1, 3)
    return {
        name: d.PlaceEntry(position=of.fit.state[PLACES][k].tolist(), sigma=_known(sigmas[k]))
        for k, name in enumerate(of.session.named("place"))
    }


def _planes(of: FittedCalibration) -> dict[str, d.PlaneEntry]:
    sigmas = of.sigmas_of(PLANES).reshape(-1, 3)
    return {
        name: d.PlaneEntry(
            normal=of.fit.state[PLANES][k, :3].tolist(), offset=of.fit.state[PLANES][k, 3], sigma=_known(sigmas[k])
        )
        for k, name in enumerate(of.session.named("plane"))
    }


def _targets(of: FittedCalibration) -> dict[str, d.TargetEntry]:
    frames = of.session.attachments
    result = {}
    for T, (name, carrier), target in zip(of.estimate.targets, frames.carried, of.session.targets, strict=True):
        exact = target.sigma is not None and not target.sigma.any()
        sigma: list[float | None] = [0.0] * 6 if exact else _known(of.sigmas_of(target_key(name)))
        result[name] = d.TargetEntry(link=frames.frames[carrier], T_link_target=T.tolist(), sigma=sigma)
    return result


def _camera(of: FittedCalibration, c: int) -> d.CameraEntry:
    """A camera's lens, and its pose in the world or on its link; of an arm that moved its clock's time offset."""
    camera, T, attachments = of.estimate.cameras[c], of.estimate.T_cam_frame[c], of.session.attachments
    frame = int(attachments.camera[c])
    pose = {"T_cam_world": T.tolist()} if frame == 0 else {"T_link_camera": inverse(T).tolist()}
    lens, moved = of.sigmas_of(lens_key(camera.name)), of.sigmas_of(pose_key(camera.name))
    sigma = {"intrinsics": _known(lens[:4]), "distortion": _known(lens[4:])} if len(lens) else {}
    if len(moved):
        sigma[next(iter(pose))] = _known(moved)
    more: dict[str, Any] = dict(pose)
    if len(of.estimate.time_offsets):
        clocks = of.sigmas_of(TIME_OFFSETS)
        more["time_offset"] = d.TimeOffsetEntry(
            value=float(of.estimate.time_offsets[c]), sigma=_known(clocks[c : c + 1])[0] if len(clocks) else None
        )
    return d.CameraEntry(
        intrinsics=camera.intrinsics.tolist(),
        distortion_model=camera.distortion_model,
        distortion=camera.distortion.tolist(),
        link=attachments.frames[frame],
        sigma=d.CameraSigmas(**sigma),
        **more,
    )


def _fit(of: FittedCalibration) -> d.FitSection:
    fit, rms = of.fit, {}
    states = {"nominal_": of.nominal_fit.state, "": fit.state}
    triangulated = triangulate(of.session) if of.estimate.cameras else None
    if triangulated is not None:
        points = arrange(of.session, triangulated)
        used = points.valid & ~of.problem.suspect(points, fit.outlier)
        rms = {f"rms_{p}mm": 1e3 * _rms(of.problem.residual(points, state)[used]) for p, state in states.items()}
    residuals = []
    for block, kept in zip(of.observations, fit.kept, strict=True):
        for found in _residuals(of, block, kept):
            residuals.append(found)
            if found.unit in ("px", "mm"):
                rms = {f"rms_nominal_{found.unit}": found.rms_nominal, f"rms_{found.unit}": found.rms} | rms
    return d.FitSection(
        poses=len(of.problem.poses),
        observations=fit.observations,
        parameters=fit.parameters.count,
        rank=of.identifiability.rank,
        iterations=len(fit.history),
        converged=fit.converged,
        reduced_chi2=fit.reduced_chi2 if fit.freedom > 0 else None,
        residuals=residuals,
        **rms,
    )


def _validation(of: FittedCalibration) -> d.ValidationSection:
    """Both arms with the same cameras; over measurements that are no outliers; for pixels the distance across the ray.

    Of an arm that moved the interval is of whole seconds: the errors of neighbouring frames are alike.
    """
    chosen, nominal = of.comparison.chosen, of.comparison.nominal_arm
    distance = 1e3 * chosen.residuals("distance")
    unit = of.problem.readings.unit
    low, high = rms_interval(of.observations, chosen.fit.kept, chosen.held_out.distance, unit, of.seed)
    pixels = {}
    if of.estimate.cameras:
        pixels = {
            f"rms_{prefix}px": _rms(trial.residuals("residual")[:, None])
            for prefix, trial in (("nominal_", nominal), ("", chosen))
        }
    return d.ValidationSection(
        folds=chosen.held_out.folds,
        rms_nominal_mm=1e3 * _rms(nominal.residuals("distance")[:, None]),
        rms_mm=_rms(distance[:, None]),
        interval_mm=[1e3 * low, 1e3 * high],
        max_mm=float(distance.max()),
        p95_mm=float(np.percentile(distance, 95)),
        **pixels,
    )


def _evidence(of: FittedCalibration) -> dict[str, Any]:
    """What speaks for and against the estimate beside its residuals."""
    evidence, session = of.evidence, of.session
    regions, scale = evidence.regions, evidence.scale
    q, names = session.chain.readings(session.q), session.chain.actuated
    return {
        "tip": e.TipSection(rms_mm=1e3 * evidence.tip.rms, interval_mm=[1e3 * end for end in evidence.tip.interval]),
        "regions": e.RegionsSection(
            count=regions.count,
            rms_nominal_mm=1e3 * regions.rms_nominal,
            rms_mm=1e3 * regions.rms,
            interval_mm=[1e3 * end if np.isfinite(end) else None for end in regions.interval],
        ),
        "scale": e.ScaleSection(
            tip_mm_per_permille=1e3 * scale.tip_per_permille,
            factor=scale.factor,
            factor_sigma=scale.sigma if np.isfinite(scale.sigma) else None,
            declared_sigma=scale.declared,
            unit=scale.unit,
        ),
        "noise": {
            noise.name: e.NoiseEntry(
                unit=noise.unit, declared=noise.declared, found=noise.found, relative_sigma=noise.relative_sigma
            )
            for noise in evidence.noise
        },
        "findings": [
            e.FindingEntry(
                name=finding.name,
                sentence=finding.sentence,
                share=finding.share,
                pose=None if finding.pose is None else session.label(finding.pose),
                alike=list(finding.alike),
            )
            for finding in evidence.findings
        ],
        "domain": e.DomainSection(
            joints={name: [float(q[:, k].min()), float(q[:, k].max())] for k, name in enumerate(names)}
        ),
    }


def _outliers(of: FittedCalibration) -> list[d.OutlierEntry]:
    """The measurements taken out of the fit: pose, camera, LED and residual (px, or mm for points)."""
    found = []
    for block, cut, norms in zip(of.observations, of.fit.outlier, of.fit.norms, strict=True):
        (_, scale, numbers), *_ = block.table.reports()
        residual = of.problem.residual(block, of.fit.state)[..., numbers]
        cameras = block.index.get("camera")
        key = "led" if "led" in block.index else "target"
        names = of.session.led_names if key == "led" else of.session.attachments.targets
        for group, slot in np.argwhere(cut):
            found.append(
                d.OutlierEntry(
                    pose=of.session.poses[block.pose[group]],
                    camera=None if cameras is None else of.estimate.cameras[cameras[group, slot]].name,
                    led=names[block.index[key][group, slot]],
                    residual=scale * float(np.linalg.norm(residual[group, slot])),
                    sigmas=float(norms[group, slot]),
                )
            )
    return found


def _known(sigmas: Floats) -> e.Sigmas:
    """Standard deviations, None where a value was fixed."""
    return [float(s) if np.isfinite(s) else None for s in sigmas]


def _rms(residual: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=-1)))) if residual.size else float("nan")
