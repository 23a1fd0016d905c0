"""Whether the true arm collides with nothing in planned poses and on the moves between, and its LEDs are found there.

    python -m tests.benchmarks.planned_poses [--plans 10] [--poses 50] [--rigs ur5 panda so101 tiago] [--images 2]

From 8 random poses of simulated arms ``--poses`` more are planned, and the poses to check by. Judged by coal on the
undilated meshes of the true arm, by itself, with the table where the plans take it to be and the cameras as balls of 4
cm: the poses, 200 samples of each move, and the rays from LEDs to cameras, but by the solids that hold these. Images of
``--images`` plans of each rig are rendered, and the LEDs looked for in them.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
from joblib import Parallel, delayed
from pinocchio import coal

from tests.measuring import measured_at
from urdfcal.arrays import one_blas_thread
from urdfcal.detection.detect import detect
from urdfcal.errors import UrdfcalError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.planning.planner import Planner
from urdfcal.robot.urdf.urdf import package_roots
from urdfcal.simulation.images import Exposure, write_simulated_images
from urdfcal.simulation.simulate import simulate
from urdfcal.simulation.truth import Simulated

SAMPLES, RANDOM = 200, 100
TABLE, CAMERA = -0.03, 0.04
# A ray begins beside the LED's housing and ends before the camera's. [m]
BESIDE, BEFORE, RAY = 0.015, 0.05, 5e-4


class Judge:
    """The true arm's meshes, the table and the cameras; a pair that collides in all of many poses is built so."""

    def __init__(self, simulated: Simulated) -> None:
        truth, urdf = simulated.truth, simulated.session.urdf
        text = truth.urdf.decode()
        self.scene, self.model = truth, pin.buildModelFromXML(text)
        folders = [str(of) for of in (*package_roots(), urdf.path.parent)]
        self.geometry = pin.buildGeomFromUrdfString(self.model, text, pin.GeometryType.COLLISION, package_dirs=folders)
        self.solids = len(self.geometry.geometryObjects)
        table = coal.Halfspace(np.array([0.0, 0.0, 1.0]), TABLE)
        # What stands is where the base link is.
        base = self.model.frames[self.model.getFrameId(truth.chain.base_link, pin.FrameType.BODY)]
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, pin.neutral(self.model))
        self.T = data.oMi[base.parentJoint] * base.placement
        self.geometry.addGeometryObject(pin.GeometryObject("table", 0, self.T, table))
        riding = [simulated.session.attachments.camera[k] != 0 for k in range(len(truth.cameras))]
        centres = truth.camera_centres(truth.q[:1])[0]
        for centre, rides in zip(centres, riding, strict=True):
            if not rides:
                ball = pin.GeometryObject("camera", 0, self.T * pin.SE3(np.eye(3), centre), coal.Sphere(CAMERA))
                self.geometry.addGeometryObject(ball)
        # A solid's hull holds its mesh: what does not touch by hulls does not by meshes, and is known 100 times sooner.
        self.hulls = pin.GeometryModel(self.geometry)
        for solid in self.hulls.geometryObjects:
            if isinstance(solid.geometry, coal.BVHModelBase):
                solid.geometry.buildConvexHull(True, "Qt")
                solid.geometry = solid.geometry.convex
        joints = [one.parentJoint for one in self.geometry.geometryObjects]
        for i, j in combinations(range(len(joints)), 2):
            low, high = sorted((joints[i], joints[j]))
            if low != high and (j >= self.solids or self.model.parents[high] != low):
                for geometry in (self.geometry, self.hulls):
                    geometry.addCollisionPair(pin.CollisionPair(i, j))
        self.data, self.placed, self.placed_hulls = data, self.geometry.createData(), self.hulls.createData()
        by_design = np.ones(len(self.geometry.collisionPairs), dtype=bool)
        for q in truth.chain.random_values(RANDOM, np.random.default_rng(1)):
            by_design[by_design] = [self._touch(k) for k in np.flatnonzero(by_design) if self._at(q, k)]
        self.pairs = np.flatnonzero(~by_design)

    def _at(self, q: np.ndarray, first: int = 0) -> bool:
        if first == 0 or self._q is not q:
            self._q, values = q, pin.neutral(self.model)
            for name, value in zip(self.scene.chain.names, q, strict=True):
                joint = self.model.joints[self.model.getJointId(name)]
                here = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
                values[joint.idx_q : joint.idx_q + joint.nq] = here
            pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.placed, values)
            pin.updateGeometryPlacements(self.model, self.data, self.hulls, self.placed_hulls, values)
        return True

    _q: np.ndarray | None = None

    def _touch(self, pair: int) -> bool:
        if not pin.computeCollision(self.hulls, self.placed_hulls, int(pair)):
            return False
        return bool(pin.computeCollision(self.geometry, self.placed, int(pair)))

    def collides(self, q: np.ndarray) -> bool:
        """Whether the arm collides at joint values (n,)."""
        self._at(q)
        return any(self._touch(k) for k in self.pairs)

    def hidden(self, q: np.ndarray) -> int:
        """How many LEDs at joint values (n,) are hidden from a camera."""
        self._at(q)
        count, ball = 0, coal.Sphere(RAY)
        for led in self.scene.led_positions(q[None])[0][: self.scene.led_count]:
            for centre in self.scene.camera_centres(q[None])[0]:
                along = (centre - led) / np.linalg.norm(centre - led)
                a, b = led + BESIDE * along, centre - BEFORE * along
                ray, turn = coal.Capsule(RAY, float(np.linalg.norm(b - a))), pin.Quaternion.FromTwoVectors
                M = self.T * pin.SE3(turn(np.array([0.0, 0.0, 1.0]), along).matrix(), (a + b) / 2.0)
                ends = [self.T * pin.SE3(np.eye(3), end) for end in (led, centre)]
                others = (k for k in range(self.solids) if not any(self._holds(k, ball, end) for end in ends))
                count += any(self._meets(k, ray, M) for k in others)
        return count

    def _holds(self, solid: int, ball: coal.Sphere, M: pin.SE3) -> bool:
        return _meet(self.hulls, self.placed_hulls, solid, ball, M)

    def _meets(self, solid: int, ray: coal.Capsule, M: pin.SE3) -> bool:
        return self._holds(solid, ray, M) and _meet(self.geometry, self.placed, solid, ray, M)


def _meet(geometry: pin.GeometryModel, placed: pin.GeometryData, solid: int, shape: object, M: pin.SE3) -> bool:
    T = [coal.Transform3s(of.rotation, of.translation) for of in (placed.oMg[solid], M)]
    own = geometry.geometryObjects[solid].geometry
    return bool(coal.collide(own, T[0], shape, T[1], coal.CollisionRequest(), coal.CollisionResult()))


def judged(name: str, seed: int, poses: int, images: bool) -> np.ndarray | str:
    """Poses, those that collide, LEDs hidden; moves, those that collide; LEDs in images, and those not found (7,)."""
    with one_blas_thread():
        simulated = simulate(read_rig(find_rig(name)), seed=seed, poses=8)
        try:
            plan = Planner(simulated.session, seed=seed).plan(poses, check=True)
        except UrdfcalError as error:
            return f"{name} {seed}: {error.what}"
        judge = Judge(simulated)
        # Where it was measured last it stands, whatever it touches there.
        first = simulated.truth.q[-1:]
        way = plan.q if judge.collides(first[0]) else np.vstack([first, plan.q])
        steps = np.linspace(0.0, 1.0, SAMPLES)
        moves = [any(judge.collides(a + step * (b - a)) for step in steps) for a, b in pairwise(way)]
        measured = plan.q[plan.measured]
        hits = [judge.collides(q) for q in plan.q]
        hidden = sum(judge.hidden(q) for q in measured)
        seen = _looked_for(simulated, measured, seed) if images else (0, 0)
    return np.array([len(plan.q), sum(hits), hidden, len(moves), sum(moves), *seen])


def _looked_for(simulated: Simulated, q: np.ndarray, seed: int) -> tuple[int, int]:
    """How many LEDs images of poses (N, n) show, and how many of these are not found."""
    session = measured_at(simulated, q, seed)
    there = Simulated(session, replace(simulated.truth, q=q, readings=q, outliers=np.zeros(0, np.intp)))
    with tempfile.TemporaryDirectory() as folder:
        count = write_simulated_images(Path(folder) / "s", there, Exposure())
        return count, count - detect(Path(folder) / "s").found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plans", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--rigs", nargs="*", default=["ur5", "panda", "so101", "tiago"])
    parser.add_argument("--images", type=int, default=2)
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    columns = ("plans", "poses", "collide", "hidden", "moves", "collide", "images", "missed")
    print(f"{'rig':8}" + "".join(f"{column:>9}" for column in columns))
    for name in arguments.rigs:
        tasks = (
            delayed(judged)(name, arguments.first + k, arguments.poses, k < arguments.images)
            for k in range(arguments.plans)
        )
        results = Parallel(n_jobs=arguments.processes)(tasks)
        rows = [result for result in results if not isinstance(result, str)]
        total = np.sum(rows, axis=0, dtype=int) if rows else np.zeros(7, dtype=int)
        print(f"{name:8}{len(rows):9}" + "".join(f"{value:9}" for value in total), flush=True)
        for result in results:
            if isinstance(result, str):
                print(result)


if __name__ == "__main__":
    main()
