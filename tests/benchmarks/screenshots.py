"""The pictures of the README, from the real thing; run it again after every change of what is shown.

    python tests/benchmarks/screenshots.py [--rig ur5] [--session FOLDER] [--output tests/screenshots]

Needs the Debian packages mesa-vulkan-drivers (the viewer without a screen) and chromium (the report).
Exits 1 if a view of any tab reports an error.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import rerun_cli
from rerun.experimental import ViewerClient

from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output import recording
from urdfcal.output.findings import Overview
from urdfcal.output.report import write_report
from urdfcal.pipeline import calibrate
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session

_POSE = 10
_WINDOW = (1600, 900)
_WIDTH = 1100
_COLORS = 256


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rig", default="ur5")
    parser.add_argument("--session", type=Path, help="measured data instead of a simulated rig")
    parser.add_argument("--fixed", action="store_true", help="with the lenses as given, whatever comes of it")
    parser.add_argument("--output", type=Path, default=Path(__file__).parents[1] / "screenshots")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    if arguments.session:
        session = read_session(arguments.session)
    else:
        session = simulate(read_rig(find_rig(arguments.rig)), poses=50, seed=0).session
    name = arguments.session.name if arguments.session else arguments.rig
    calibration = _calibrated(session, arguments.fixed)
    reports = []
    with tempfile.TemporaryDirectory() as folder:
        reports = _tabs(calibration, Path(folder), arguments.output / name)
        _report(calibration, Path(folder), arguments.output / f"{name}_report.png")
    print("\n".join(reports) or "no view reports an error")
    return int(bool(reports))


def _calibrated(session: Session, fixed: bool) -> FittedCalibration:
    if not fixed:
        return calibrate(session)
    estimate = replace(session.estimate, geometry="dh", intrinsics="fixed")
    return calibrate(replace(session, estimate=estimate), force=True)


def _tabs(calibration: FittedCalibration, folder: Path, stem: Path) -> list[str]:
    """Show every tab in turn; return what its views complain of."""
    overview, layout = Overview.of(calibration), recording.layout
    complaints = []
    tabs = [str(view.name).lower().replace(" ", "_") for view in layout(overview).root_container.contents]
    for index, tab in enumerate(tabs):
        path = folder / f"{tab}.rrd"
        recording.layout = lambda what, active=index: layout(what, active)
        try:
            recording.write_recording(path, overview)
        finally:
            recording.layout = layout
        png, found = _shown(path)
        complaints += [f"{tab}: {text}" for text in found]
        _save(png, stem.with_name(f"{stem.name}_{tab}.png"))
    return complaints


def _shown(recording: Path) -> tuple[bytes, list[str]]:
    """Open a recording in the headless viewer until two frames agree; a picture, and the views' errors."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    viewer = Path(rerun_cli.__file__).parent / "rerun"
    size = "x".join(map(str, _WINDOW))
    with tempfile.TemporaryDirectory() as home:
        process = subprocess.Popen(
            [viewer, "--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", size,
             "--hide-welcome-screen"],
            env={**os.environ, "HOME": home}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            client = _connected(port)
            client.open(str(recording))
            time.sleep(1.0)
            client.set_time("pose", sequence=_POSE, play_state="paused")
            previous, end = None, time.time() + 60
            while time.time() < end:
                state, png = client.get_state(), client.take_screenshot()
                if state.recordings and not state.loading and png == previous:
                    errors = [f"{v.name}: {r.summary}" for v in state.views for r in v.reports if r.severity == "error"]
                    return png, errors
                previous = png
                time.sleep(0.4)
            return png, ["the viewer does not come to rest"]
        finally:
            process.terminate()
            process.wait(20)


def _connected(port: int) -> ViewerClient:
    for _ in range(150):
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
        except ConnectionError:
            time.sleep(0.1)
        else:
            return client
    raise TimeoutError("the headless viewer does not start: are mesa-vulkan-drivers installed?")


def _report(calibration: FittedCalibration, folder: Path, path: Path) -> None:
    page, png = folder / "report.html", folder / "report.png"
    write_report(page, Overview.of(calibration))
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder / 'home'}"]
    subprocess.run(
        ["chromium", *options, f"--screenshot={png}", "--window-size=1280,1500", page.as_uri()],
        check=True, capture_output=True,
    )  # fmt: skip
    _save(png.read_bytes(), path)


def _save(png: bytes, path: Path) -> None:
    """Smaller, with a palette: a tenth of the bytes, and nobody sees it."""
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    height = round(picture.shape[0] * _WIDTH / picture.shape[1])
    picture = cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    from PIL import Image  # comes with rerun; OpenCV writes no palettes

    Image.fromarray(picture[..., ::-1]).quantize(_COLORS).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
