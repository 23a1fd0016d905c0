"""The measurements that the calibrated arm predicts worst, each on a crop of its picture where there is one."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.output.images import find_shots

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.output.findings import Overview

_SHOWN = 10
# A crop shows so many pixels about the detection, or so much more than the miss, and is so large on the page.
_LEAST, _ROOM, _SIZE = 12.0, 1.6, 144


@dataclass(frozen=True)
class Miss:
    """A measurement and how far the calibrated arm's prediction is off.

    Attributes:
        pose: its label.
        number: of the pose, counted from 1, as the viewer's slider has it.
        led: its name, or the target's.
        camera: its name; "" where another instrument measured.
        residual: the prediction's distance. [unit]
        unit: px for pixels, else mm or the kind's own.
        sigmas: the rms of its components in standard deviations.
        outlier: whether it was taken out of the fit.
        crop: its picture with detection and prediction, as SVG; "" where there is none.
    """

    pose: str
    number: int
    led: str
    camera: str
    residual: float
    unit: str
    sigmas: float
    outlier: bool
    crop: str


def worst(overview: Overview) -> list[Miss]:
    """The ten measurements of the first kind that are predicted worst, the worst first."""
    table, calibration = overview.scene.tables[0], overview.calibration
    session, cameras = calibration.session, calibration.estimate.cameras
    names = (*session.led_names, *session.attachments.targets)
    shots = find_shots(session) if table.by_camera else ()
    size = np.nan_to_num(table.size, nan=np.inf)
    found = []
    for k in np.argsort(-size, kind="stable")[:_SHOWN].tolist():
        pose, led, camera = int(table.pose[k]), int(table.led[k]), int(table.camera[k])
        crop = ""
        if table.by_camera and (path := shots[camera].get((pose, led if led < len(session.leds) else -1))):
            crop = _crop(path, table.measured[k], table.predicted[k])
        found.append(
            Miss(
                pose=session.poses[pose],
                number=pose + 1,
                led=names[led],
                camera=cameras[camera].name if table.by_camera else "",
                residual=float(table.scale * np.linalg.norm(table.predicted[k] - table.measured[k])),
                unit=table.unit,
                sigmas=float(size[k]),
                outlier=bool(table.outlier[k]),
                crop=crop,
            )
        )
    return found


def _crop(path: Path, measured: Floats, predicted: Floats) -> str:
    """Cut a picture about a detection, as bright as it can be, with a ring about it and a cross at the prediction."""
    import cv2

    image = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        return ""
    away = float(np.nan_to_num(np.abs(predicted - measured).max(), nan=0.0))
    half = int(min(max(_LEAST, _ROOM * away), max(image.shape) / 2))
    left, top = np.round(measured).astype(int) - half
    part = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_CONSTANT)[
        max(top + half, 0) : top + 3 * half + 1, max(left + half, 0) : left + 3 * half + 1
    ]
    if not part.size:
        return ""
    part = cv2.normalize(part, None, 0, 255, cv2.NORM_MINMAX)
    scale = max(1, round(2 * _SIZE / max(part.shape)))
    part = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    done, data = cv2.imencode(".png", part)
    if not done:
        return ""
    side, (u, v) = 2 * half + 1, measured - [left, top] + 0.5
    picture = base64.b64encode(data.tobytes()).decode()
    ring, line = 0.12 * side, 0.012 * side
    marks = f'<circle cx="{u:.2f}" cy="{v:.2f}" r="{ring:.2f}" fill="none" stroke="#fff" stroke-width="{line:.2f}"/>'
    if np.isfinite(predicted).all():
        (x, y), arm = predicted - [left, top] + 0.5, 0.07 * side
        cross = f"M{x - arm:.2f} {y:.2f}h{2 * arm:.2f}M{x:.2f} {y - arm:.2f}v{2 * arm:.2f}"
        marks += f'<path d="{cross}" stroke="#3cd296" stroke-width="{line:.2f}"/>'
    return (
        f'<svg class="crop" viewBox="0 0 {side} {side}" width="{_SIZE}" height="{_SIZE}" '
        f'xmlns="http://www.w3.org/2000/svg"><image href="data:image/png;base64,{picture}" width="{side}" '
        f'height="{side}" preserveAspectRatio="none"/>{marks}</svg>'
    )
