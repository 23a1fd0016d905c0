from __future__ import annotations

import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest
import rerun as rr

from urdfcal.cli import run
from urdfcal.errors import OutputError
from urdfcal.output import live, viewer
from urdfcal.output.findings import Overview
from urdfcal.output.live import LiveView
from urdfcal.output.viewer import Viewer
from urdfcal.pipeline import calibrate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
LISTENS = """
import socket, sys, time
arguments = sys.argv[1:]
with socket.create_server((arguments[arguments.index("--bind") + 1], int(arguments[arguments.index("--port") + 1]))):
    time.sleep({seconds})
sys.exit(1)
"""


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """A viewer that listens for a while, on a machine with a screen."""
    program = folder / "rerun"
    program.write_text(f"#!{sys.executable}\n{LISTENS.format(seconds=seconds)}")
    program.chmod(0o755)
    monkeypatch.setattr(viewer, "_rerun", lambda: str(program))
    monkeypatch.setenv("DISPLAY", ":0")


def without_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in SCREENS:
        monkeypatch.delenv(name, raising=False)


def test_every_fit_is_a_curve_of_its_own() -> None:
    stream = rr.RecordingStream("live")
    memory = stream.memory_recording()
    view = LiveView(stream)
    curves = []
    log = stream.log

    def noted(path: str, *what: object, **how: object) -> None:
        curves.append(path)
        log(path, *what, **how)

    stream.log = noted
    for iteration, cost in ((1, 100.0), (2, 10.0), (1, 1000.0), (2, 5.0), (3, 0.0)):
        view.step(iteration, cost)
    view.close()
    assert memory.num_msgs() > 0
    assert [path for path in dict.fromkeys(curves) if "fit" in path] == ["live/cost/fit_1", "live/cost/fit_2"]


def test_a_clock_ticks_while_nothing_else_is_to_be_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_TICK", 0.01)
    stream = rr.RecordingStream("live")
    memory = stream.memory_recording()
    view = LiveView(stream)
    view.say("thinking")
    before, end = memory.num_msgs(), time.monotonic() + 10.0
    while memory.num_msgs() < before + 3:
        assert time.monotonic() < end
        time.sleep(0.02)
    view.close()


def test_without_a_screen_it_is_refused_before_anything_is_calibrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without_screen(monkeypatch)
    assert run(["simulate", "elbow3r", "-o", str(tmp_path / "s"), "--poses", "8"]) == 0
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "o"), "--live"]) == 2
    said = capsys.readouterr().err
    assert "none of DISPLAY, WAYLAND_DISPLAY, WAYLAND_SOCKET is set" in said
    assert "urdfcal view --web" in said
    assert not (tmp_path / "o").exists()


def test_a_viewer_that_stops_at_once_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, seconds=0.05)
    with pytest.raises(OutputError, match="does not start: it stopped with code 1"):
        Viewer.start()


def test_the_viewer_is_asked_to_listen_to_this_machine_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, seconds=30.0)
    started = Viewer.start()
    try:
        assert started.open
        arguments = started.process.args
        assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"
        assert started.address == f"rerun+http://127.0.0.1:{started.port}/proxy"
    finally:
        started.process.kill()
        started.process.wait()


@pytest.mark.no_cover
def test_a_viewer_that_is_closed_meanwhile_holds_nothing_up(tmp_path: Path) -> None:
    """In a process of its own: what hung was its end."""
    program = tmp_path / "rerun"
    program.write_text(f"#!{sys.executable}\n{LISTENS.format(seconds=0.8)}")
    program.chmod(0o755)
    code = f"""
import time
from urdfcal.output import viewer
viewer._rerun = lambda: {str(program)!r}
from urdfcal.output.live import LiveView
view = LiveView()
view.step(1, 10.0)
time.sleep(0.8)
assert not view.watched
view.step(2, 5.0)
assert not view.finish(None)
print("done")
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env={"DISPLAY": ":0"}, check=False
    )
    assert ended.stdout == "done\n", ended.stderr
    assert ended.returncode == 0


def test_the_result_follows(simulated: Callable) -> None:
    calibration = calibrate(simulated("elbow3r", poses=12).session, force=True)
    stream = rr.RecordingStream("live")
    memory = stream.memory_recording()
    view = LiveView(stream)
    view.step(1, 5.0)
    before = memory.num_msgs()
    assert view.finish(Overview.of(calibration))
    assert memory.num_msgs() > before + 50
