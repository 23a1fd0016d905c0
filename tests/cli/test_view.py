from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.browser import CHROMIUM, Browser
from urdfcal.cli import run
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.palette import VERDICT_COLORS
from urdfcal.simulation.simulate import simulate, write_simulated

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session") / "session"
    write_simulated(folder, simulate(read_rig(find_rig("elbow3r")), poses=15, seed=3, outliers=0.05))
    return folder


@pytest.fixture(scope="module")
def result(session: Path) -> Path:
    out = session.parent / "out"
    assert run(["calibrate", str(session), "-o", str(out), "--quiet"]) == 0
    return out


def test_quiet_prints_nothing(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", str(session), "-o", str(tmp_path), "-q"]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")
    assert {path.suffix for path in tmp_path.iterdir()} == {".urdf", ".json", ".html", ".rrd"}


def test_json_is_the_written_file_and_the_list_of_files(
    session: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(session), "-o", str(tmp_path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["verdict"]["level"] in {"good", "doubtful"}
    assert set(printed.pop("files")) == {"urdf", "json", "html", "rrd"}
    assert printed == json.loads((result / "calibration.json").read_text())


@pytest.mark.parametrize("rig", ["elbow3r", "panda"])
def test_summary_is_short_and_says_the_verdict_first(
    rig: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_simulated(tmp_path / "s", simulate(read_rig(find_rig(rig)), poses=20, seed=1))
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "o")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 25
    document = json.loads((tmp_path / "o" / "calibration.json").read_text())
    assert lines[0].startswith(f"{document['robot']['name']}: ")
    validation = document["validation"]
    assert f"{validation['rms_nominal_mm']:.3g} -> {validation['rms_mm']:.3g} mm" in lines[1]
    assert sum(name in line for line in lines[-3:] for name in (".urdf", "report.html", "calibration.rrd")) == 3
    assert "\x1b" not in "".join(lines)


def test_save_copies_the_recording(result: Path, tmp_path: Path) -> None:
    assert run(["view", str(result), "--save", str(tmp_path / "copy.rrd")]) == 0
    assert (tmp_path / "copy.rrd").read_bytes() == (result / "calibration.rrd").read_bytes()


def test_a_result_is_named_by_its_calibration_too(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["view", str(result / "calibration.json"), "--save", str(tmp_path / "copy.rrd")]) == 0
    assert (tmp_path / "copy.rrd").read_bytes() == (result / "calibration.rrd").read_bytes()
    (tmp_path / "alone").mkdir()
    alone = tmp_path / "alone" / "calibration.json"
    alone.write_bytes((result / "calibration.json").read_bytes())
    assert run(["view", str(alone), "--save", str(tmp_path / "no.rrd")]) == 2
    assert "there is no recording here" in capsys.readouterr().err


def test_overlay_is_a_picture_of_every_camera(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import cv2

    assert run(["view", str(result), "--overlay", "04", "--save", str(tmp_path / "o.png")]) == 0
    assert "there is no picture of pose 04 by cam0, cam1: the arm is drawn on dark ground" in capsys.readouterr().err
    picture = cv2.imread(str(tmp_path / "o.png"))
    assert picture.shape[0] == 1024
    assert picture.shape[1] > 2 * 1280
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    assert run(["view", str(result), "--overlay", "nosuch", "--save", str(tmp_path / "p.png")]) == 2
    assert "no pose 'nosuch'" in capsys.readouterr().err
    assert not (tmp_path / "p.png").exists()


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@pytest.fixture
def served(result: Path) -> Iterator[tuple[int, str]]:
    """A result served as a web page: its port, and the first line printed."""
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "urdfcal", "view", str(result), "--web", "--port", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        end = time.time() + 20
        while not _answers(port):
            assert process.poll() is None
            assert time.time() < end
            time.sleep(0.05)
        yield port, address
    finally:
        process.terminate()
        assert process.wait(20) is not None


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_the_address_is_the_first_thing_that_is_printed(served: tuple[int, str]) -> None:
    port, address = served
    assert address.startswith(f"http://127.0.0.1:{port}?url=rerun%2Bhttp")


def test_the_web_page_is_served_to_this_machine_only(served: tuple[int, str]) -> None:
    port, _ = served
    with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert b"200 OK" in connection.recv(200)
    assert listening_elsewhere(port) == []


def listening_elsewhere(port: int) -> list[str]:
    """Addresses other than loopback on which the process that holds a port listens, as Linux lists them."""
    sockets = [line.split() for table in ("tcp", "tcp6") for line in _lines(f"/proc/net/{table}")]
    listening = {row[9]: row[1] for row in sockets if row[3] == "0A"}
    (held,) = [inode for inode, place in listening.items() if int(place.split(":")[1], 16) == port]
    (mine,) = [inodes for inodes in _open_sockets() if held in inodes]
    return [place for inode, place in listening.items() if inode in mine and not place.startswith("0100007F")]


def _lines(path: str) -> list[str]:
    return Path(path).read_text().splitlines()[1:]


def _open_sockets() -> Iterator[set[str]]:
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            names = [str(entry.readlink()) for entry in folder.iterdir()]
        except OSError:  # ended meanwhile, or not ours
            continue
        yield {name[8:-1] for name in names if name.startswith("socket:[")}


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_shows_the_recording(served: tuple[int, str], result: Path, tmp_path: Path) -> None:
    import cv2

    _, address = served
    browser = Browser(tmp_path)
    try:
        browser.open(address)
        end, shown = time.time() + 60, 0
        while shown < 5000 and time.time() < end:  # the banner in the verdict's colour
            time.sleep(0.5)
            picture = browser.screenshot()
            pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
            colors = [np.abs(pixels - color).max(axis=-1) < 12 for color in VERDICT_COLORS.values()]
            shown = max(int(color.sum()) for color in colors)
        (tmp_path / "page.png").write_bytes(picture)
        assert shown >= 5000
    finally:
        browser.close()
