"""Opening a recording in the rerun viewer."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from urllib.parse import quote

from urdfcal import files
from urdfcal.errors import OutputError

RECORDING = "calibration.rrd"
_LOOPBACK = "127.0.0.1"
# Any of these tells a program of Linux where its windows go.
_SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
# From a cold disk it starts in seconds; without a screen it stops 0.1 s after it listens. [s]
_STARTING, _OPENING = 20.0, 0.5


def find_recording(folder: Path) -> Path:
    """The recording of a result folder or of the calibration.json in it, or the file itself.

    Raises:
        OutputError: there is none.
    """
    recording = folder / RECORDING if folder.is_dir() else folder
    if recording.suffix == ".json":
        recording = recording.with_name(RECORDING)
    files.settle(recording.parent)
    if not recording.is_file():
        raise OutputError(
            "there is no recording here", where=str(folder), remedy="Name the folder that urdfcal calibrate -o wrote."
        )
    return recording


def open_recording(recording: Path) -> None:
    """Start the viewer on a recording and wait until it is closed.

    Raises:
        OutputError: the viewer cannot open a window.
    """
    ended = subprocess.run([_rerun(), "--bind", _LOOPBACK, str(recording)], check=False).returncode  # noqa: S603
    if ended != 0:
        raise OutputError(
            f"the rerun viewer stopped with code {ended}",
            where=str(recording),
            remedy="It needs a screen; without one: urdfcal view --web, or --save and look at it elsewhere.",
        )


@dataclass(frozen=True, eq=False)
class Viewer:
    """A rerun viewer that waits for data, from this machine only.

    Attributes:
        process: the viewer; it stays open when ours ends.
        port: where it listens.
    """

    process: subprocess.Popen[bytes]
    port: int

    @classmethod
    def start(cls) -> Viewer:
        """Start it, and wait until it listens.

        Raises:
            OutputError: it is not installed, or cannot open a window.
        """
        remedy = "It needs a screen: leave --live out, and look at the result later: urdfcal view --web."
        if sys.platform == "linux" and not any(os.environ.get(name) for name in _SCREENS):
            raise OutputError(f"the rerun viewer does not start: none of {', '.join(_SCREENS)} is set", remedy=remedy)
        port = _free_port()
        command = [_rerun(), "--bind", _LOOPBACK, "--port", str(port), "--expect-data-soon"]
        nowhere = subprocess.DEVNULL
        process = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere, start_new_session=True)  # noqa: S603
        viewer = cls(process, port)
        end = time.monotonic() + _STARTING
        while viewer.open and time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex((_LOOPBACK, port)) == 0:
                    break
            time.sleep(0.02)
        # It listens a little before it opens its window.
        with suppress(subprocess.TimeoutExpired):
            viewer.process.wait(_OPENING)
        if not viewer.open:
            code = viewer.process.returncode
            raise OutputError(f"the rerun viewer does not start: it stopped with code {code}", remedy=remedy)
        return viewer

    @property
    def open(self) -> bool:
        """Whether it runs."""
        return self.process.poll() is None

    @property
    def address(self) -> str:
        """Where to send data."""
        return f"rerun+http://{_LOOPBACK}:{self.port}/proxy"


def serve_recording(recording: Path, port: int = 0) -> NoReturn:
    """Print an address and become the server of a recording as a web page there, to this machine only.

    This process is replaced, so that whatever ends it ends the server.

    Args:
        recording: the file.
        port: of the page; 0 takes a free one.
    """
    data = _free_port()
    page = port or _free_port()
    sent = quote(f"rerun+http://{_LOOPBACK}:{data}/proxy", safe="")
    print(f"http://{_LOOPBACK}:{page}?url={sent}\nOpen it in a browser; ctrl+c ends it.", flush=True)
    ports = ["--port", str(data), "--web-viewer-port", str(page)]
    # What the viewer logs buries the address; what keeps it from serving does not.
    quiet = {**os.environ, "RUST_LOG": os.environ.get("RUST_LOG", "error")}
    os.execve(_rerun(), ["rerun", "--serve-web", "--bind", _LOOPBACK, *ports, str(recording)], quiet)  # noqa: S606


def _free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((_LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _rerun() -> str:
    """The viewer itself; the command ``rerun`` is a wrapper that leaves it behind when ended."""
    from importlib.util import find_spec

    package = find_spec("rerun_cli")
    folder = Path(package.origin).parent if package is not None and package.origin else Path()
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    if not (folder / name).is_file():
        raise OutputError("the rerun viewer is not installed", remedy="Install the package rerun-sdk.")
    return str(folder / name)
