"""An arm that was calibrated before, and is to be measured again: what is known of it and where its cameras stand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.session.attachments import CameraMount
from urdfcal.session.knowledge import Estimate, Led, Noise, Tolerances
from urdfcal.session.model import Setup
from urdfcal.simulation.scene import Scene

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.result.calibration import Calibration
    from urdfcal.result.document import ResultDocument
    from urdfcal.robot.urdf.urdf import Urdf

_REMEDY = "Name the session that it was calibrated from, or a rig, instead."


def scene_of(calibration: Calibration, urdf: Urdf | None) -> tuple[Setup, Scene]:
    """Return the calibrated arm before the cameras that it was calibrated with, and where all that is.

    Its geometry is known as well as it came out; joints' zeros, which change when a motor or a belt does, are as
    unknown as of any arm.

    Args:
        calibration: the earlier result.
        urdf: the corrected one, which the arm's solids are in; None where it is not there.

    Raises:
        SessionError: the result does not say what is to be measured with.
    """
    document = calibration.document
    if not document.cameras:
        raise SessionError("it was calibrated without cameras", where="plan", remedy=_REMEDY)
    if document.targets or document.sessions:
        what = "several sessions" if document.sessions else "targets, and does not say what these look like"
        raise SessionError(f"it was calibrated with {what}", where="plan", remedy=_REMEDY)
    chain = calibration.chain.with_placements(calibration.placements)
    cameras, mounts = tuple(_camera(document, name) for name in document.cameras), []
    for name, entry in document.cameras.items():
        if entry.T_link_camera is not None:
            mounts.append(CameraMount(name, entry.link, np.array(entry.T_link_camera)))
    standing = [np.array(entry.T_cam_world) for entry in document.cameras.values() if entry.T_cam_world is not None]
    T_cam_world = tuple(
        None if entry.T_cam_world is None else np.array(entry.T_cam_world) @ inverse(standing[0])
        for entry in document.cameras.values()
    )
    setup = Setup(
        chain=chain,
        leds=tuple(_led(document, name) for name in document.leds),
        rig=Rig(cameras, T_cam_world),
        mounts=tuple(mounts),
        urdf=urdf,
        urdf_reference=document.robot.urdf,
        noise=_noise(document),
        estimate=Estimate("dh", "fixed", None if mounts else "fixed"),
        tolerances=tolerances_of(document),
    )
    return setup, Scene(
        chain=chain,
        placements=chain.placements,
        attachments=setup.attachments,
        leds=np.array([led.position for led in document.leds.values()]).reshape(-1, 3),
        targets=np.zeros((0, 4, 4)),
        T_world_base=np.array(document.T_world_base),
        cameras=cameras,
        T_cam_frame=np.array([_in_camera(document, name) for name in document.cameras]),
    )


def tolerances_of(document: ResultDocument) -> Tolerances:
    """Return how well an arm is known once it is calibrated: rms of what came out, zero offsets apart."""
    kinds = {name: joint.type for name, joint in document.robot.joints.items()}
    # A joint's own variable is its zero offset.
    rows = [e for e in document.dh if e.parameter != ("d" if kinds.get(e.joint) == "prismatic" else "theta")]
    sigmas = {unit: [e.sigma for e in rows if e.unit == unit and e.sigma is not None] for unit in ("m", "rad")}
    known = {name: _rms(sigmas[unit]) for name, unit in (("length", "m"), ("angle", "rad")) if sigmas[unit]}
    usual = Tolerances()
    return Tolerances(**{name: min(sigma, getattr(usual, name)) for name, sigma in known.items()})


def _camera(document: ResultDocument, name: str) -> Camera:
    entry = document.cameras[name]
    if entry.resolution is None:
        what = f"an earlier version wrote it, which does not say how large the images of {name!r} are"
        raise SessionError(what, where="plan", remedy=_REMEDY)
    width, height = entry.resolution
    return Camera(name, (width, height), np.array(entry.intrinsics), entry.distortion_model, np.array(entry.distortion))


def _in_camera(document: ResultDocument, name: str) -> Floats:
    """The camera's world or link in its own frame (4, 4). [m]."""
    entry = document.cameras[name]
    return np.array(entry.T_cam_world) if entry.T_cam_world is not None else inverse(np.array(entry.T_link_camera))


def _led(document: ResultDocument, name: str) -> Led:
    entry = document.leds[name]
    known = [sigma for sigma in entry.sigma if sigma is not None]
    return Led(name, np.array(entry.position), _rms(known) if known else 0.0, entry.link)


def _noise(document: ResultDocument) -> Noise:
    levels = {name: of.found if of.declared is None else of.declared for name, of in document.noise.items()}
    return Noise(pixel=levels.get("pixel"), joint=levels.get("joint"))


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
