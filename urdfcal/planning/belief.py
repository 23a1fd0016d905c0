"""What is known of an arm before more is measured, and what a pose would add to it (METHOD 16)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import covariance_of
from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.known_distances import KnownDistances
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.model_spec import nominal
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.snapshot import Snapshot
from urdfcal.estimation.start import first_state
from urdfcal.estimation.uncertainty import tip_sensitivity
from urdfcal.estimation.whitening import Whitening, joint_noise
from urdfcal.planning.design import Candidates
from urdfcal.robot.placements import PlacementTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.model import MIN_POSES, Positions, Setup
from urdfcal.session.moves import lasting_leds
from urdfcal.session.trajectory import Trajectory
from urdfcal.simulation.scene import Scene
from urdfcal.simulation.simulate import nominal_scene

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.state import State
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.knowledge import ArmGeometry
    from urdfcal.session.model import Session
    from urdfcal.session.rig_description import RigDescription

# What has no prior is known to this, once scaled as 1 m or 1 rad: by eye, so that no pose is expected to tell all.
_BY_EYE = 0.1
# Poses that are whitened at a time.
_BLOCK = 500


@dataclass(frozen=True, eq=False)
class Belief:
    """An arm as far as it is known.

    Attributes:
        setup: the arm, its LEDs and its cameras.
        scene: where all that is, as estimated.
        problem: whose parameters they are.
        state: the estimate that measurements are linearised at.
        parameters: what is estimated, of the rigid arm all.
        information: (P, P) of them, of what is measured and of priors.
        misfit: factor on the noise of measurements: how far residuals exceed it.
        q: (n,) the last measured pose; None where nothing is measured. [rad or m]
    """

    setup: Setup
    scene: Scene
    problem: Problem
    state: State
    parameters: Parameters
    information: Floats
    misfit: float
    q: Floats | None

    @classmethod
    def of_rig(cls, rig: RigDescription, q: Floats) -> Belief:
        """Take the arm and the stand as they are meant to be.

        Args:
            rig: with cameras.
            q: (N, n) poses in which its cameras see it. [rad or m]

        Raises:
            SessionError: something is not given, such as where an LED is.
        """
        return cls.of_scene(rig, nominal_scene(rig), q)

    @classmethod
    def of_scene(cls, setup: Setup, scene: Scene, q: Floats) -> Belief:
        """Take the arm, its cameras and LEDs to be where they are in a scene, poses (N, n) of which they see."""
        session = expected_session(setup, scene, q)
        problem = Problem.of(session, _arm_of(session))
        state = first_state(session, problem.arm, no_offsets(problem.arm))
        spec = replace(nominal(session, state), geometry=_geometry(session))
        parameters = choose_parameters(session, problem, state, spec)
        return cls(setup, scene, problem, state, parameters, _by_priors(parameters, state), 1.0, None)

    @classmethod
    def of_calibration(cls, calibration: FittedCalibration) -> Belief:
        """Take what a calibration has found, and the whole rigid arm as unknown where it took part of it as nominal."""
        session, fit, problem = calibration.session, calibration.fit, calibration.problem
        state, arm = fit.state, problem.arm
        spec = replace(calibration.comparison.chosen.spec, geometry=_geometry(session), priors=True)
        parameters = choose_parameters(session, problem, state, spec)
        found = Snapshot.of(problem, state)
        scene = Scene(
            chain=arm.chain,
            placements=arm.placements(found.offsets),
            attachments=session.attachments,
            leds=found.leds,
            targets=found.targets,
            T_world_base=found.T_world_bases[-1],
            cameras=found.cameras,
            T_cam_frame=found.T_cam_frame,
        )
        misfit = float(np.sqrt(fit.reduced_chi2)) if fit.misfit else 1.0
        setup = Setup(**session.of_setup())
        priors = _by_priors(parameters, state)
        return cls(setup, scene, problem, state, parameters, priors, misfit, session.q[-1]).with_session(session)

    def with_session(self, session: Session) -> Belief:
        """Add what a session's measurements tell to the priors."""
        problem = Problem.of(session, self.problem.arm)
        information = _by_priors(self.parameters, self.state)
        for observed in problem.observations:
            F = self.factors(problem, observed).reshape(-1, self.parameters.count)
            information = information + F.T @ F
        return replace(self, problem=problem, information=information, q=session.q[-1])

    def with_distance(self, sigma: float) -> tuple[tuple[str, str], Belief] | None:
        """Take the distance of two LEDs as measured, of those on one link whose is unknown the farthest apart.

        LEDs that moved count for none: they were there one after the other.

        Args:
            sigma: how well. [m]

        Returns:
            The two, and what is known then; None where no link has two such.
        """
        places, frames, names = self.state[LEDS], self.setup.attachments.led, [led.name for led in self.setup.leds]
        known_already = {frozenset(distance.leds) for distance in self.setup.led_distances}
        pairs = [
            (a, b)
            for a, b in combinations(lasting_leds(self.setup), 2)
            if frames[a] == frames[b] and {names[a], names[b]} not in known_already
        ]
        if not pairs:
            return None
        apart = [float(np.linalg.norm(places[a] - places[b])) for a, b in pairs]
        a, b = pairs[int(np.argmax(apart))]
        (of, active), known = (
            self.parameters.active_columns(LEDS),
            KnownDistances(LEDS, ((a, b, max(apart), sigma),), len(names)),
        )
        J = np.zeros((1, self.parameters.count))
        J[:, of] = known.residuals(self.state)[1][:, active]
        return (names[a], names[b]), replace(self, information=self.information + J.T @ J)

    def identified_by(self, q: Floats) -> Belief:
        """Fix at its nominal value what not even poses ``q`` (N, n) would identify, as an estimate does. [rad or m]."""
        problem = Problem.of(expected_session(self.setup, self.scene, q), self.problem.arm)
        parameters = identify(problem, self.state, self.parameters).parameters
        kept = parameters.active[self.parameters.active]
        return replace(self, parameters=parameters, information=self.information[np.ix_(kept, kept)])

    def candidates(self, q: Floats, workspace: Floats, progress: Callable[[float], object] | None = None) -> Candidates:
        """Say what poses would tell, and what of it matters.

        Args:
            q: (N, n) the poses. [rad or m]
            workspace: (M, n) where the tip is to be accurate. [rad or m]
            progress: called with the number of poses done since the last call.
        """
        A = tip_sensitivity(self.problem, self.state, self.parameters, workspace)
        R = np.linalg.qr(A.reshape(-1, self.parameters.count), mode="r") / np.sqrt(len(workspace))
        return Candidates(self.told_by(q, progress), np.ascontiguousarray(R.T))

    def tip_errors(self, information: Floats, workspace: Floats) -> Floats:
        """Return the tip's expected error (M,) at each of joint values (M, n), at an information (P, P). [m]."""
        A = tip_sensitivity(self.problem, self.state, self.parameters, workspace)
        return np.asarray(np.sqrt(np.einsum("mij,jk,mik->m", A, covariance_of(information), A)))

    def told_by(self, q: Floats, progress: Callable[[float], object] | None = None) -> Floats:
        """Return whitened Jacobians (N, r, P) of what poses (N, n) would show. [rad or m]."""
        enough = q[np.arange(max(len(q), MIN_POSES)) % len(q)]  # of fewer no session can be
        problem = Problem.of(expected_session(self.setup, self.scene, enough), self.problem.arm)
        (observed,) = problem.observations
        return self.factors(problem, observed, progress)[: len(q)]

    def factors(
        self, problem: Problem, observed: Observations, progress: Callable[[float], object] | None = None
    ) -> Floats:
        """Whitened Jacobians (N, r, P) of poses, of no more rows than there are parameters."""
        tangent = Tangent.at(problem, observed, self.state, self.parameters)
        readings, parts = problem.mechanism.reading_jacobian, []
        for first in range(0, len(observed.pose), _BLOCK):
            poses = slice(first, first + _BLOCK)
            at = tangent.linearise(poses)
            N, m, D, P = at.J.shape
            joint = joint_noise(at, readings, problem.joint_sigma)
            F = Whitening.of(observed.covariance[poses], joint)(at.J.reshape(N, m * D, P)) / self.misfit
            parts.append(np.linalg.qr(F, mode="r") if m * D > P else F)
            if progress is not None:
                progress(N)
        return np.concatenate(parts)


def expected_session(setup: Setup, scene: Scene, q: Floats) -> Session:
    """Return what the cameras of a scene would see without noise in poses ``q`` (N, n)."""
    part = np.full(len(q), len(setup.parts) - 1)
    positions = Positions(**setup.of_setup(), poses=tuple(str(k) for k in range(len(q))), q=q, part=part)
    uv = scene.pixels(q)
    pose, camera, led = np.nonzero(scene.in_image(uv) & scene.turned_to(q))
    sigma = np.array(setup.noise.of(Detections))
    return positions.measured((Detections(pose, camera, led, uv[pose, camera, led], sigma),))


def check_plannable(setup: Setup) -> None:
    """Refuse what no poses can be planned for.

    Raises:
        SessionError: no camera is there, or the arm moved while it was measured.
    """
    if not setup.rig.cameras:
        what = "no camera is there: of what else measures, it is not known where it sees the arm"
        remedy = "`urdfcal plan` of a rig with the cameras that you could use says what they would bring."
        raise SessionError(what, where=str(setup.folder or "setup"), remedy=remedy)
    if isinstance(getattr(setup, "motion", None), Trajectory):
        remedy = "Plan from its rig; then let the arm rest in every pose, or drive through them."
        raise SessionError("the arm moved while it was measured", where=str(setup.folder or "setup"), remedy=remedy)


def _by_priors(parameters: Parameters, state: State) -> Floats:
    """Information (P, P) of what is known beforehand."""
    _, J = parameters.prior_residuals(state)
    unknown = ~np.isfinite(parameters.prior[parameters.active])
    scale = _BY_EYE * parameters.scales(state)[parameters.active]
    return np.asarray(J.T @ J + np.diag(np.where(unknown, scale**-2.0, 0.0)))


def _arm_of(session: Session) -> ArmParameterization:
    return PlacementTable(session.chain) if _geometry(session) == "full" else rows_of(session.chain)


def _geometry(session: Session) -> ArmGeometry:
    return "full" if session.estimate.geometry == "full" else "dh"
