"""Poses to measure: without collisions, every LED in every image and in sight, spread over images and joints."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from pinocchio import coal

from urdfcal.errors import RobotError, SessionError
from urdfcal.robot.mechanism import BASE
from urdfcal.rotations import turn_z_to
from urdfcal.simulation.hulls import hulls_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.model import Setup
    from urdfcal.session.obstacle import Obstacle
    from urdfcal.simulation.scene import Scene

# What stands on a table may reach below its own origin: mounting plates, cables, a table that is not flat. [m]
_TABLE = -0.03
# Of a camera on its tripod: what clearance is kept of, is kept of this, too. [m]
_STAND = 0.1
# Of an LED in its housing, and of the ray that has to pass. [m]
_BULB = 0.004
_RAY = 0.001
# What is kept of the ray, of the clearance: an arm that is a millimetre elsewhere hid 2 of 144 LEDs without.
_GRAZE = 0.25
# ... of what is fixed to the LED's own link, which it is at most a few millimetres elsewhere on: with as much as of
# others no pose is left of an SO-101 with a tag on its gripper.
_GRAZE_OWN = 0.1
# A pair that collides in all of these random poses overlaps by design, or hangs below its base as a leg does.
# A pair that is free in one pose of ten is taken for such a one in 1.5 % of cases.
_TRIALS = 40
# A pair that comes nearer than a clearance in more of those in which it is free is built so near, as the second link
# of a Tiago's arm to its torso: with 2 cm between them one pose in 150 would be left. Such pairs do in 65 % to all of
# them (ur5, tiago, stanford), others, and the table, in at most 25 %.
_BY_DESIGN = 0.5

MARGIN = 40.0
"""How far from an image's border an LED is planned to appear, px; the errors drawn move it by up to 25."""

# Share of a joint's range left free at either end.
_LIMIT_MARGIN = 0.02
# Cells of the image, about square, and of a joint's range, that the poses are spread over evenly.
_IMAGE_CELLS = (5, 4)
_JOINT_CELLS = 6
# Candidates a pose with the LED in view: an even choice is left when obstacles take nine in ten.
_CANDIDATES = 40
_BATCH = 4000
# After 200,000 draws (a second) the choice is among what was found: of 50 poses' candidates, if fewer than one
# configuration in a hundred shows the LED.
_MOST_BATCHES = 50


class CollisionChecker:
    """The collision geometry of the nominal arm, each solid by its convex hull.

    Joints off the chain stay at zero. Not compared are solids of the same link or of links that one joint
    connects, and pairs that collide in every pose. A hull holds more than its mesh, so that some poses are refused
    that the arm could take; but a pose of SO-101 is checked in 0.15 ms, with its meshes it would be 40 ms.

    Attributes:
        empty: whether the description has no collision geometry at all.
    """

    def __init__(
        self,
        chain: Mechanism,
        urdf: Urdf,
        leds: Sequence[tuple[int, Floats]],
        centres: Sequence[tuple[int, Floats]],
        clearance: float = 0.0,
        scene: Sequence[Obstacle] = (),
    ) -> None:
        """Load the geometry.

        Args:
            chain: the arm.
            urdf: the description that the chain was read from.
            leds: index of the joint that carries each LED, ``BASE`` for none, and its position (3,) there. [m]
            centres: the same of the cameras' centres.
            clearance: how near is a collision already, of pairs that are not built as near. With some, the arm
                keeps clear of the cameras that stand around it, too, and a share of it of what they look at. [m]
            scene: what stands around the arm. It hides LEDs, and clearance is kept of it, however near it is.

        Raises:
            RobotError: a mesh cannot be found or read.
            SessionError: a box of the scene is in the arm's way wherever it goes.
        """
        solids = hulls_of(chain, urdf)
        bulb, table = coal.Sphere(_BULB), coal.Halfspace(np.array([0.0, 0.0, 1.0]), _TABLE)
        self._leds = [(joint + 1, pin.SE3(np.eye(3), position)) for joint, position in leds]
        self._rays = _RAY + _GRAZE * clearance, _RAY + _GRAZE_OWN * clearance
        bulbs = [pin.GeometryObject(f"LED {i}", joint, M, bulb) for i, (joint, M) in enumerate(self._leds)]
        self._geometry = pin.GeometryModel()
        stands = [
            pin.GeometryObject(f"camera {i}", 0, pin.SE3(np.eye(3), centre), coal.Sphere(_STAND))
            for i, (joint, centre) in enumerate(centres)
            if clearance and joint == BASE
        ]
        boxes = [
            pin.GeometryObject(f"box {box.name}", 0, pin.SE3(box.T_base_box), coal.Box(*box.size)) for box in scene
        ]
        before = len(solids) + len(bulbs) + len(stands)
        self._around = range(before, before + len(boxes))
        for one in (*solids, *bulbs, *stands, *boxes, pin.GeometryObject("table", 0, pin.SE3.Identity(), table)):
            self._geometry.addGeometryObject(one)
        self._model = chain.build_model()
        self._data = self._model.createData()
        self._add_pairs(chain)
        self._placed = self._geometry.createData()
        if clearance:
            self._keep_clear(chain, clearance)
        # A solid that holds an LED or a camera carries it: on which side of it that sits is unknown here.
        ends = [*self._leds, *((joint + 1, pin.SE3(np.eye(3), position)) for joint, position in centres)]
        screens = (*range(len(solids)), *self._around)
        carriers = [
            {
                i
                for i, solid in ((i, self._geometry.geometryObjects[i]) for i in screens)
                if solid.parentJoint == joint and _touch(solid.geometry, solid.placement, bulb, M)
            }
            for joint, M in ends
        ]
        self._screens = [
            [[i for i in screens if i not in of_led | of_camera] for of_camera in carriers[len(leds) :]]
            for of_led in carriers[: len(leds)]
        ]
        self.empty = not solids

    def is_free(self, q: Floats) -> bool:
        """Return whether the arm collides with nothing at joint values ``q`` (n,)."""
        return not pin.computeCollisions(self._model, self._data, self._geometry, self._placed, q, True)

    def is_seen(self, q: Floats, centres: Floats) -> bool:
        """Return whether the arm at ``q`` (n,) hides no LED from a camera, ``centres`` (C, 3) in the base's frame."""
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._placed, q)
        for (joint, M), by_camera in zip(self._leds, self._screens, strict=True):
            led = (self._data.oMi[joint] * M).translation
            for centre, screens in zip(centres, by_camera, strict=True):
                line = centre - led
                length, placement = float(np.linalg.norm(line)), pin.SE3(turn_z_to(line), (led + centre) / 2.0)
                rays = [coal.Capsule(radius, length) for radius in self._rays]
                solids = ((self._geometry.geometryObjects[i], self._placed.oMg[i]) for i in screens)
                if any(_touch(of.geometry, M_0, rays[of.parentJoint == joint != 0], placement) for of, M_0 in solids):
                    return False
        return True

    def _add_pairs(self, chain: Mechanism) -> None:
        joints = [one.parentJoint for one in self._geometry.geometryObjects]
        table = len(joints) - 1
        pairs = []
        for i, j in combinations(range(len(joints)), 2):
            a, b = sorted((joints[i], joints[j]))
            # Neighbours touch by design, but what stands around is nobody's neighbour.
            if a != b and (j == table or self._is_around(pin.CollisionPair(i, j)) or self._model.parents[b] != a):
                pairs.append(pin.CollisionPair(i, j))
                self._geometry.addCollisionPair(pairs[-1])
        for k in np.flatnonzero(self._share(chain, self._geometry.createData()) == 1.0):
            first, second = (self._geometry.geometryObjects[i].name for i in (pairs[k].first, pairs[k].second))
            if self._is_around(pairs[k]):
                remedy = "Make it smaller, or leave it out: what the arm stands on, it does not keep clear of."
                raise SessionError(f"{first} collides with {second} in every pose", where="scene", remedy=remedy)
            self._geometry.removeCollisionPair(pairs[k])

    def _is_around(self, pair: pin.CollisionPair) -> bool:
        """Return whether a pair is of the arm and a box that stands around it."""
        return pair.first in self._around or pair.second in self._around

    def _keep_clear(self, chain: Mechanism, clearance: float) -> None:
        """Ask a clearance of every pair that is not near by design."""
        collides = self._share(chain, self._geometry.createData())
        for request in self._placed.collisionRequests:
            request.security_margin = clearance
        # Of boxes clearance is kept, unless that leaves no pose at all: those the arm stands on.
        around = np.array([self._is_around(pair) for pair in self._geometry.collisionPairs], dtype=bool)
        share = self._share(chain, self._placed)
        near = np.where(around, share == 1.0, share - collides > _BY_DESIGN * (1.0 - collides))
        for request, by_design in zip(self._placed.collisionRequests, near, strict=True):
            request.security_margin = 0.0 if by_design else clearance

    def _share(self, chain: Mechanism, placed: pin.GeometryData) -> Floats:
        """In what share of random poses each pair collides."""
        count = np.zeros(len(self._geometry.collisionPairs))
        for q in chain.random_values(_TRIALS, np.random.default_rng(0)):
            pin.computeCollisions(self._model, self._data, self._geometry, placed, q, False)
            count += [result.isCollision() for result in placed.collisionResults]
        return count / _TRIALS


def load_collision_checker(
    nominal: Scene, setup: Setup, clearance: float = 0.0
) -> tuple[CollisionChecker | None, tuple[str, ...]]:
    """Return the collision geometry of the arm, or None and a warning that says why there is none.

    Args:
        nominal: where LEDs and cameras are.
        setup: the arm.
        clearance: to be kept. [m]
    """
    if setup.urdf is None:
        return None, ("no URDF: the poses were not checked for collisions",)
    try:
        checker = CollisionChecker(setup.chain, setup.urdf, *nominal.points_on_joints(), clearance, setup.scene)
    except RobotError as error:
        return None, (f"the poses were not checked for collisions: {error}",)
    if checker.empty:
        return None, (f"{setup.urdf_reference}: no collision geometry, the poses were not checked",)
    return checker, ()


def _touch(a: Any, M_a: pin.SE3, b: Any, M_b: pin.SE3) -> bool:
    T_a, T_b = (coal.Transform3s(M.rotation, M.translation) for M in (M_a, M_b))
    return bool(coal.collide(a, T_a, b, T_b, coal.CollisionRequest(), coal.CollisionResult()))


def sample_poses(
    scene: Scene,
    checker: CollisionChecker | None,
    count: int,
    rng: np.random.Generator,
    progress: Callable[[int], object] | None = None,
) -> Floats:
    """Sample poses one after the other, each where the poses before it left the largest gaps.

    A gap is a cell of an image, or of a joint's range, that few poses fall into.

    Args:
        scene: the nominal arm and cameras.
        checker: says which poses the arm can take; None when that is not known.
        count: how many poses.
        rng: the source of randomness.
        progress: called with the number of poses found since the last call.

    Returns:
        (count, n) values of all joints of the chain. [rad or m]

    Raises:
        SessionError: there are not enough such poses, with what stands in the way.
    """
    q, uv, drawn = in_view(scene, _CANDIDATES * count, rng)
    cells, centres = _cells(scene, q, uv), scene.camera_centres(q)
    filled = np.zeros(cells.max(initial=0) + 1)
    open_, score = np.ones(len(cells), dtype=bool), np.full(len(cells), 1.0)
    chosen: list[int] = []
    while len(chosen) < count and open_.any():
        best = int(np.argmax(np.where(open_, score, -1.0)))
        open_[best] = False
        if checker and not (checker.is_free(q[best]) and checker.is_seen(q[best], centres[best])):
            continue
        chosen.append(best)
        filled[cells[best]] += 1.0
        score = (1.0 / (1.0 + filled[cells])).sum(axis=1)
        if progress:
            progress(1)
    if len(chosen) < count:
        raise SessionError(
            f"{len(chosen)} of {count} poses found: of {drawn} random ones every camera sees the LED in "
            f"{len(cells)}, and {len(chosen)} of these keep clear of the arm, the table and the line of sight",
            where="stand",
            remedy="Let the cameras stand further away or look at the middle of the workspace, or ask for fewer poses.",
        )
    return q[chosen]


def in_view(scene: Scene, needed: int, rng: np.random.Generator, margin: float = MARGIN) -> tuple[Floats, Floats, int]:
    """Draw poses with every LED in view of every camera, and facing it.

    Args:
        scene: the arm and cameras.
        needed: how many are enough.
        rng: the source of randomness.
        margin: from the images' borders. [px]

    Returns:
        The poses (M, n), their pixels (M, C, L, 2), and of how many draws they are.
    """
    lower, upper = joint_limits(scene.chain)
    actuated = [i for i, joint in enumerate(scene.chain.joints) if joint.mimic is None]
    q: list[Floats] = []
    uv: list[Floats] = []
    drawn = 0
    while drawn < _MOST_BATCHES * _BATCH and sum(len(batch) for batch in q) < needed:
        readings = rng.uniform(lower[actuated], upper[actuated], (_BATCH, len(actuated)))
        values = scene.chain.joint_values(readings)
        good, pixels = are_in_view(scene, values, margin)
        q.append(values[good])
        uv.append(pixels[good])
        drawn += _BATCH
    return np.concatenate(q)[:needed], np.concatenate(uv)[:needed], drawn


def are_in_view(scene: Scene, q: Floats, margin: float = MARGIN) -> tuple[Bools, Floats]:
    """Return which of some poses (N, n) are within the limits and have every LED in view of every camera, facing it.

    Args:
        scene: the arm and cameras.
        q: joint values. [rad or m]
        margin: from the images' borders. [px]

    Returns:
        (N,) which, and the pixels (N, C, L, 2) of all.
    """
    lower, upper = joint_limits(scene.chain)
    pixels = scene.pixels(q)
    # A mimic joint may leave its own limits while its master keeps to them.
    within = np.all((q >= lower) & (q <= upper), axis=1)
    return within & scene.in_image(pixels, margin).all(axis=(1, 2)) & scene.faced(q).all(axis=(1, 2)), pixels


def _cells(scene: Scene, q: Floats, uv: Floats) -> Ints:
    """Number the cells that each candidate falls into, (M, features): one a camera and LED, one a joint."""
    columns, rows = _IMAGE_CELLS
    sizes = np.array([camera.resolution for camera in scene.cameras])[:, None]
    across, down = np.moveaxis((uv - MARGIN) / (sizes - 2.0 * MARGIN), -1, 0)
    in_image = _bin(across, columns) * rows + _bin(down, rows)
    lower, upper = joint_limits(scene.chain)
    in_joint = _bin((q - lower) / np.where(upper > lower, upper - lower, 1.0), _JOINT_CELLS)
    cells = np.concatenate([in_image.reshape(len(q), in_image.shape[1] * in_image.shape[2]), in_joint], axis=1)
    first = np.arange(cells.shape[1]) * max(columns * rows, _JOINT_CELLS)
    return np.asarray(cells + first)


def _bin(share: Floats, count: int) -> Ints:
    return np.clip((share * count).astype(np.intp), 0, count - 1)


def joint_limits(chain: Mechanism) -> tuple[Floats, Floats]:
    """Return the range of every joint that poses are drawn from, (n,) and (n,).

    Of more than a turn (or endless travel) it is the turn (or the metre) nearest to zero.
    """
    lower, upper = np.array([(joint.lower, joint.upper) for joint in chain.joints]).T
    travel, slides = upper - lower, [joint.prismatic for joint in chain.joints]
    longest = np.where(slides, np.where(np.isfinite(travel), travel, 1.0), 2.0 * np.pi)
    middle = np.clip(0.0, lower + longest / 2.0, upper - longest / 2.0)
    lower = np.where(travel > longest, middle - longest / 2.0, lower)
    upper = np.where(travel > longest, middle + longest / 2.0, upper)
    margin = _LIMIT_MARGIN * (upper - lower)
    return lower + margin, upper - margin
