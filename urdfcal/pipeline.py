"""The pipeline: from a session to a calibrated robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from urdfcal.arrays import one_blas_thread
from urdfcal.errors import CalibrationError, SessionError, placed
from urdfcal.estimation.assessment import assess
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.cameras import without_cameras
from urdfcal.estimation.diagnosis.trials import suspect
from urdfcal.estimation.evidence import gather
from urdfcal.estimation.joint_models.time_offset import time_offsets
from urdfcal.estimation.measurements.pixels import Detections, triangulate
from urdfcal.estimation.model_selection import compare_models, with_fit
from urdfcal.estimation.multistart import Minimum, multistart
from urdfcal.estimation.noise import find_noise
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.time_offset_start import start_state
from urdfcal.result.fitted import FittedCalibration
from urdfcal.robot.placements import PlacementTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.moves import resolve_moves
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.estimation.solver import Progress
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session

# What looks like noise of the joint readings may be errors that repeat, as of an encoder's eccentricity: weights that
# take them for noise are kept where they predict held-out poses no worse than by chance (an IRB 120: 9 % worse).
_NO_WORSE = 1.05

Method = Literal["pixels", "points"]


def calibrate(
    session: Session | str | Path,
    *,
    method: Method = "pixels",
    priors: bool = True,
    starts: int = 0,
    seed: int = 0,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedCalibration:
    """Estimate the real robot's geometry from a session.

    Maximum likelihood on pixels (or a tracker's points), whitened by the declared noise of measurements and joint
    readings, with manufacturing tolerances as priors; robust against outliers (Rossi, Savino et al., eq. 8 and 22).
    The start is found in closed form. Where the session does not say what to estimate, the model that predicts
    held-out poses best is chosen. Unidentifiable parameters are fixed at their nominal value.

    Args:
        session: what was measured, or the path of its folder.
        method: whether the cameras' pixels count, or the points triangulated from them with their covariances.
        priors: whether manufacturing and LED tolerances act as priors; without, plain least squares (eq. 8 of Rossi
            et al.).
        starts: how many other arms to start from, near the nominal one and far from it; the minima are screened.
        seed: random seed of the division into folds, of other starts, and of the configurations at which the result
            is checked.
        force: return the result even if its assessment has failures; ``Calibration.failures`` says which.
        progress: called after every solver step.

    Raises:
        CalibrationError: there is no start, or the result fails its assessment: no convergence, a misfit, no better
            than the nominal arm on held-out poses, or lenses that the detections refute.
        SessionError: the session cannot be read, or names measurements that exclude each other.
    """
    if isinstance(session, (str, Path)):
        from urdfcal.io.folder import read_session

        session = read_session(session)
    session = resolve_moves(session)
    with placed(session.folder or "session"), one_blas_thread():
        return _calibrate(
            session, method=method, priors=priors, starts=starts, seed=seed, force=force, progress=progress
        )


def _calibrate(
    session: Session, *, method: Method, priors: bool, starts: int, seed: int, force: bool, progress: Progress | None
) -> FittedCalibration:
    table = rows_of(session.chain)
    arm: ArmParameterization = PlacementTable(session.chain) if session.estimate.geometry == "full" else table
    problem = Problem.of(session, arm)
    by_part = [of.table.by_part(session.part) for of in problem.observations]
    for k in range(len(session.parts)):
        in_world = [of[k] for of in by_part if k in of and of[k].defines_world(session.attachments)]
        if len({"camera" in of.keys for of in in_world}) < 2:
            continue
        raise SessionError(
            f"{' and '.join(of.kind for of in in_world)} are both named: the tracker's frame is not the first camera's",
            remedy="Name one of them; evaluate --points checks a result against the other.",
        )
    start = _start(session, arm, progress)
    recorded = session.recorded(time_offsets(start))
    if recorded is not session:
        session, problem = recorded, Problem.of(recorded, arm)
    if method == "points":
        others = [of.table for of in problem.observations if not isinstance(of.table, Detections)]
        problem, start = Problem.of(session, arm, [_as_points(session), *others]), without_cameras(start)
    comparison = compare_models(session, problem, start, priors=priors, seed=seed, progress=progress)
    undeclared = session.undeclared_noise
    if undeclared and method == "pixels":
        found = {of.name: of.found for of in find_noise(problem, comparison.chosen.fit) if of.name in undeclared}
        noisy = session.with_noise(found)
        weighed = Problem.of(noisy, arm)
        again = compare_models(noisy, weighed, start, priors=priors, seed=seed, progress=progress)
        if again.chosen.rms("distance") <= _NO_WORSE * comparison.chosen.rms("distance"):
            # The nominal arm is far off: noise that the calibrated one has would only place it worse.
            session, problem, comparison = noisy, weighed, replace(again, nominal=comparison.nominal)
    solutions: tuple[Minimum, ...] = ()
    if starts:
        solutions = multistart(session, problem, comparison.chosen.fit, starts, seed, progress)
        kept = solutions[0].solution if solutions[0].kept else None
        if kept is not None and kept is not comparison.chosen.fit:
            comparison = with_fit(comparison, kept, problem, seed)
    evidence = gather(session, problem, comparison, seed, undeclared, progress)
    chosen = comparison.chosen
    fit = replace(chosen.fit, spread=evidence.spread, doubt=chosen.doubt)
    comparison = comparison.with_chosen(replace(chosen, fit=fit))
    assessment = assess(session, problem, comparison, evidence)
    calibration = FittedCalibration(
        session=session.with_time_offsets(time_offsets(comparison.chosen.fit.state)),
        table=table,
        problem=problem,
        comparison=comparison,
        solutions=solutions,
        seed=seed,
        evidence=evidence,
        assessment=assessment,
    )
    if assessment.failures and not force:
        raise refusal(calibration)
    return calibration


def refusal(calibration: FittedCalibration, report: Path | None = None) -> CalibrationError:
    """Return the error that a calibration whose assessment has failures is refused with.

    Args:
        calibration: the result, which fails.
        report: where it is reported all the same.
    """
    remedy = "--force writes it all the same."
    if report is not None:
        remedy = f"{report} shows it; {remedy}"
    return CalibrationError("; ".join(calibration.failures), where="not written", remedy=remedy)


def _start(session: Session, arm: ArmParameterization, progress: Progress | None) -> State:
    """Start; where that fails, say which single mistake would explain it."""
    try:
        return start_state(session, arm, no_offsets(arm))
    except CalibrationError as error:
        suspicion = suspect(session, progress)
        if suspicion is None:
            raise
        raise CalibrationError(f"{suspicion}; {error.what}", where=error.where, remedy=error.remedy) from error


def _as_points(session: Session) -> Measurement:
    if isinstance(session.motion, Trajectory):
        what = "no point can be triangulated: every frame is taken by one camera, at a time of its own"
        raise CalibrationError(what, remedy="Leave --method points out.")
    points = triangulate(session)
    if points is None:
        remedy = "It takes two cameras of known pose; a tracker's points.csv needs no --method points."
        raise CalibrationError("no point can be triangulated from these detections", remedy=remedy)
    return points
