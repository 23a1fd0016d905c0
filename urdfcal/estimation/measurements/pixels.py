"""Detections: the pixels at which cameras saw LEDs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.arrays import Floats, Ints, inverse
from urdfcal.cameras.rig import Rig
from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.cameras import (
    CameraPoseBlock,
    LensBlock,
    camera_poses,
    camera_values,
    has_scale,
    lens_key_of,
    own_pose,
    pose_key,
)
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.scale import SCALE, scale_of
from urdfcal.estimation.blocks.targets import point_places
from urdfcal.estimation.camera_prior import CameraPrior
from urdfcal.estimation.camera_start import Views
from urdfcal.estimation.measurements.base import BlockSet, ByFrame, Measurement, WorldPoints
from urdfcal.estimation.measurements.point_geometry import (
    by_frames,
    by_rotation,
    carry,
    led_points,
    put_leds,
    seen_from,
)
from urdfcal.estimation.measurements.points import CorrelatedPoints
from urdfcal.estimation.target_start import TargetViews, picture_poses, place_targets

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from urdfcal.cameras.camera import Camera
    from urdfcal.estimation.linearize import Jacobian
    from urdfcal.estimation.links import Links
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.attachments import Attachments
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class Detections(Measurement):
    """LEDs seen by cameras, sorted by pose, camera and LED.

    Attributes:
        pose: (S,) index of the pose.
        camera: (S,) index of the camera.
        led: (S,) index of the LED.
        uv: (S, 2) where it was seen. [px]
        sigma: (S,) standard deviation of u and of v; one number serves all. [px]
    """

    kind: ClassVar[str] = "detections"
    keys: ClassVar[tuple[str, ...]] = ("pose", "camera", "led")
    dimension: ClassVar[int] = 2
    columns: ClassVar[tuple[str, ...]] = ("u", "v")
    array: ClassVar[str] = "uv"
    noise: ClassVar[str] = "pixel"
    usual: ClassVar[float] = 0.1
    unit: ClassVar[str] = "px"
    report: ClassVar[tuple[str, float]] = ("px", 1.0)

    camera: Ints
    led: Ints
    uv: Floats
    sigma: Floats

    def predict(self, observed: Observations, links: Links, state: State) -> Floats:
        """Project the LEDs into their cameras, (N, m, 2); NaN behind a camera, zero for padding. [px]."""
        _, p_view = self.points(observed, links, state)
        camera, predicted = _camera(observed), np.zeros((*observed.row.shape, 2))
        for c, (lens, T_cam_view) in enumerate(_cameras(links.attachments, state)):
            seen = camera == c
            predicted[seen] = lens.project(p_view[seen] @ T_cam_view[:3, :3].T + T_cam_view[:3, 3])
        return predicted

    def linearise(self, observed: Observations, links: Links, state: State, J: Jacobian) -> ByFrame:
        """Differentiate the projections by the frames, the LEDs, the camera poses and the lenses."""
        attachments = links.attachments
        lever, p_base = led_points(observed, links, state)
        p_seen, m, camera = p_base.reshape(-1, 3), observed.row.shape[1], _camera(observed)
        predicted, E = np.zeros((len(p_seen), 2)), np.zeros((len(p_seen), 2, 3))
        for c, (lens, T_cam_view) in enumerate(_cameras(attachments, state)):
            seen, frame = np.flatnonzero(camera == c), int(attachments.camera[c])
            R, p = links.R[frame], links.p[frame]
            still = frame == 0 and links.one_world  # the same at every pose
            if still:
                p_view = (p_seen[seen] - p[0]) @ R[0]
            else:
                p_view = ((p_seen[seen] - p[seen // m])[:, None] @ R[seen // m])[:, 0]
            p_cam = p_view @ T_cam_view[:3, :3].T + T_cam_view[:3, 3]
            if J.wants(key := lens_key_of(attachments, c)):
                predicted[seen], d_point, d_lens = lens.project_with_derivatives(p_cam)
                J.put(key, d_lens, seen)
            else:
                predicted[seen], d_point = lens.project_with_jacobian(p_cam)
            if still:
                E[seen] = carry(d_point, T_cam_view[:3, :3] @ R[0].T)
            else:
                E[seen] = d_point @ (T_cam_view[:3, :3] @ np.swapaxes(R[seen // m], 1, 2))
            self._put_poses(J, c, d_point, p_cam, seen, attachments, state)
        put_leds(J, observed, links, E, lever, state)
        led_frame, view_frame = attachments.led[observed.index["led"]], _view_frame(observed, attachments)
        by_frame = by_frames(links, E, lever, p_base, led_frame, view_frame)
        return ByFrame(predicted.reshape(*observed.row.shape, 2), by_frame)

    @staticmethod
    def _put_poses(
        J: Jacobian, c: int, d_point: Floats, p_cam: Floats, seen: Ints, attachments: Attachments, state: State
    ) -> None:
        """Put the derivatives by a camera's pose, and by that of its reference camera."""
        name, reference = attachments.cameras[c], int(attachments.reference[c])
        scale = scale_of(state) if has_scale(attachments, c) else 1.0
        if J.wants(pose_key(name)):
            J.put(pose_key(name), np.concatenate([d_point / scale, by_rotation(d_point, p_cam)], axis=-1), seen)
        if has_scale(attachments, c) and J.wants(SCALE):
            J.put(SCALE, -(d_point @ own_pose(attachments, state, c)[:3, 3, None]) / scale, seen)
        of_reference = pose_key(attachments.cameras[reference])
        if reference != c and J.wants(of_reference):
            T_cam_reference = own_pose(attachments, state, c)
            p_reference = (p_cam - T_cam_reference[:3, 3]) @ T_cam_reference[:3, :3]
            d_reference = carry(d_point, T_cam_reference[:3, :3])
            d_pose = np.concatenate([d_reference, by_rotation(d_reference, p_reference)], axis=-1)
            J.put(of_reference, d_pose, seen)

    def metres_per_unit(self, observed: Observations, links: Links, state: State) -> Floats:
        """Return the metres at the LED, across the ray, that one pixel spans."""
        _, p_view = self.points(observed, links, state)
        result, camera = np.ones(observed.row.shape), _camera(observed)
        for c, (lens, T_cam_view) in enumerate(_cameras(links.attachments, state)):
            seen = camera == c
            depth = p_view[seen] @ T_cam_view[2, :3] + T_cam_view[2, 3]
            result[seen] = depth / np.sqrt(lens.intrinsics[0] * lens.intrinsics[1])
        return result

    def points(self, observed: Observations, links: Links, state: State) -> tuple[Ints, Floats]:
        """Return the frames that the cameras are fixed in, and the LEDs' positions in them."""
        _, p_base = led_points(observed, links, state)
        frame = _view_frame(observed, links.attachments)
        return frame, seen_from(links, p_base, frame)

    def defines_world(self, attachments: Attachments) -> bool:
        """Return whether a camera that is fixed in the world saw something."""
        return bool(np.isin(self.camera, attachments.eye_to_hand).any())

    def blocks(self, session: Session, spec: ModelSpec, state: State) -> BlockSet:
        """Return the poses, then the lenses, of the cameras that are to be estimated."""
        attachments = session.attachments
        worlds = attachments.worlds  # where the first eye-to-hand camera is, is what the world is
        moving = [c for c, freedom in enumerate(spec.extrinsics) if c not in worlds and freedom != "fixed"]
        lenses = [c for c, freedom in enumerate(spec.intrinsics) if freedom != "fixed" and attachments.lens[c] == c]
        known = CameraPrior.of(session, spec, moving, lenses)
        nominal = nominal_cameras(session, state)
        blocks: list[CameraPoseBlock | LensBlock] = []
        end = 0
        for c in moving:
            key = pose_key(attachments.cameras[c])
            end += 6
            blocks.append(CameraPoseBlock.of(attachments.cameras[c], nominal[key], known.sigma[end - 6 : end]))
        for c in lenses:
            lens = session.rig.cameras[c]
            end += len(lens.parameters)
            blocks.append(LensBlock.of(lens, known.sigma[end - len(lens.parameters) : end]))
        return BlockSet(tuple(blocks), known.correlation, known.measured)

    def world_points(self, session: Session) -> WorldPoints | None:
        """Return where the rays of eye-to-hand cameras of known pose meet."""
        found = triangulate(session)
        return None if found is None else WorldPoints(found.pose, found.led, found.xyz, complete=False)

    def target_views(self, session: Session) -> Iterator[TargetViews]:
        """Find each target in every picture of each camera by PnP."""
        attachments = session.attachments
        target, first = attachments.led[self.led] - attachments.first_target, len(session.leds)
        for t in np.unique(target[target >= 0]).tolist():
            for c, lens in enumerate(session.rig.cameras):
                mine = np.flatnonzero((target == t) & (self.camera == c))
                points = attachments.target_points[self.led[mine] - first]
                pose, T = picture_poses(lens, self.pose[mine], points, self.uv[mine])
                yield TargetViews(t, int(attachments.camera[c]), attachments.T_cam_frame[c], pose, T)

    def start(self, at: Start, state: State) -> State:
        """Place the base if need be, then the cameras, by PnP, and unknown LEDs where the cameras' rays meet."""
        attachments, views = at.session.attachments, Views(at, self, state)
        T_cam_frame = list(attachments.T_cam_frame)
        leds, bases = point_places(attachments, state), base_keys(attachments.parts)
        for k, here in self.by_part(at.session.part).items():
            if bases[k] not in state and here.defines_world(attachments):
                state = state.replace({bases[k]: replace(views, detections=here).base(T_cam_frame, leds)})
        state = place_targets(at, [self], state)
        leds, views = point_places(attachments, state), Views(at, self, state)
        T_world_base = np.array([state[key] if key in state else np.eye(4) for key in bases])[at.session.part]
        for c, T in enumerate(T_cam_frame):
            if T is None:
                reference = T_cam_frame[int(attachments.reference[c])]
                known = attachments.T_cam_reference[c]
                by_reference = None if known is None or reference is None else known @ reference
                T_cam_frame[c] = views.place(c, T_world_base, leds, by_reference)
        leds = views.meet(T_world_base, T_cam_frame, leds, at.unknown_leds)
        return state.replace({LEDS: leds[: len(at.session.leds)], **camera_state(at.session, np.array(T_cam_frame))})


def camera_state(session: Session, T_cam_frame: Floats) -> dict[Key[Any], object]:
    """Return the values of all cameras' unknowns: lenses as given, and poses (C, 4, 4) of frames in cameras. [m]."""
    values: dict[Key[Any], object] = {}
    for c, lens in enumerate(session.rig.cameras):
        reference = int(session.attachments.reference[c])
        T = T_cam_frame[c] if reference == c else T_cam_frame[c] @ inverse(T_cam_frame[reference])
        values |= {lens_key_of(session.attachments, c): session.rig.cameras[session.rig.lens[c]]}
        values |= {pose_key(lens.name): T}
    return values


def nominal_cameras(session: Session, state: State) -> dict[Key[Any], Floats]:
    """Return the pose of each camera as given, as a value of its block; where none is given, the state's. [m]."""
    attachments = session.attachments
    poses: dict[Key[Any], Floats] = {}
    for c, name in enumerate(attachments.cameras):
        given = attachments.T_cam_reference[c]
        if attachments.reference[c] == c:
            given = attachments.T_reference_frame[c]
        poses[pose_key(name)] = state[pose_key(name)] if given is None else given
    return poses


def triangulate(session: Session) -> CorrelatedPoints | None:
    """Find the points of all LEDs seen by two or more eye-to-hand cameras of known pose, with their covariances."""
    detections, attachments = session.find(Detections), session.attachments
    cameras = attachments.eye_to_hand
    if detections is None or not len(cameras):
        return None
    rig = Rig(tuple(session.rig.cameras[c] for c in cameras), tuple(attachments.T_cam_frame[c] for c in cameras))
    pose, led, uv, sigma = side_by_side(detections.index, detections.uv, detections.sigma, len(session.rig.cameras))
    result = rig.triangulate(uv[:, cameras], sigma[:, cameras])
    good = np.isfinite(result.points[:, 0])
    if not np.any(good):
        return None
    covariance = result.covariances[good]
    spread = np.sqrt(np.maximum(np.trace(covariance, axis1=1, axis2=2), 0.0) / 3.0)
    return CorrelatedPoints(pose[good], led[good], result.points[good], spread, covariance)


def side_by_side(
    index: Mapping[str, Ints], uv: Floats, sigma: Floats, cameras: int
) -> tuple[Ints, Ints, Floats, Floats]:
    """Bring all cameras' detections of one LED in one pose side by side.

    Args:
        index: pose, camera and led of S detections.
        uv: (S, 2). [px]
        sigma: (S,). [px]
        cameras: C, how many there are.

    Returns:
        Pose and LED (M,), uv (M, C, 2) with NaN where a camera does not see it, and sigma (M, C).
    """
    pose, camera, led = (index[key] for key in ("pose", "camera", "led"))
    leds = led.max() + 1
    key, group = np.unique(pose * leds + led, return_inverse=True)
    wide, spread = np.full((len(key), cameras, 2), np.nan), np.ones((len(key), cameras))
    wide[group, camera], spread[group, camera] = uv, sigma
    return key // leds, key % leds, wide, spread


def _cameras(attachments: Attachments, state: State) -> Iterator[tuple[Camera, Floats]]:
    """Each camera's lens, and the frame it is fixed in (4, 4) in the camera."""
    return zip(camera_values(attachments, state), camera_poses(attachments, state), strict=True)


def _camera(observed: Observations) -> Ints:
    """Camera (N, m) of each slot; -1 for padding, which no camera sees."""
    return np.where(observed.valid, observed.index["camera"], -1)


def _view_frame(observed: Observations, attachments: Attachments) -> Ints:
    """Frame (N, m) that each slot's camera is fixed in."""
    return attachments.camera[observed.index["camera"]]
