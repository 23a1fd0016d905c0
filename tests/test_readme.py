"""The README's commands and its library example, verbatim."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import urdfcal
from urdfcal.cli import run
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.writing import write_session
from urdfcal.robot.urdf.urdf import find_urdf
from urdfcal.simulation.simulate import simulate

README = Path(__file__).parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.no_cover
def test_what_people_do_and_the_library_example_work_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line.split("#")[0].split() for line in blocks("sh")[2].splitlines()]
    assert [line[1] for line in lines] == ["simulate", "calibrate", "view", "evaluate", "dh"]
    for line in lines:
        if line[1] != "view":  # needs a screen
            assert run(line[1:]) == 0, line
    chain = urdfcal.Calibration.load(tmp_path / "result").chain
    shutil.copy(find_urdf("package://example-robot-data/robots/panda_description/urdf/panda.urdf"), "other.urdf")
    q = chain.random_values(3, np.random.default_rng(0)).tolist()
    data = simulate(read_rig(find_rig("panda")), seed=0, poses=62)
    write_session(tmp_path / "new_session", data.session.at(np.arange(50, 62)))
    shutil.copytree("result", "later_result")
    rows = [["time", *chain.names], *([k, *row] for k, row in enumerate(q))]
    Path("path.csv").write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n")
    lines = [line.split("#")[0].split() for line in blocks("sh")[3].splitlines()]
    assert [line[1] for line in lines] == ["apply", "compensate", "export", "export", "verify", "compare", "batch"]
    for line in lines:
        assert run(line[1:]) == 0, line
    lines = [line.split("#")[0].split() for line in blocks("sh")[4].splitlines()]
    assert [line[1] for line in lines] == ["plan", "simulate", "detect", "calibrate", "evaluate", "plan"]
    for line in lines:
        assert run(line[1:]) == 0, line
    lines = [line.split("#")[0].split() for line in blocks("sh")[5].splitlines()]
    assert [line[1] for line in lines] == ["simulate", "calibrate", "evaluate"]
    for line in lines:
        assert run(line[1:]) == 0, line
    (example,) = blocks("python")
    ended = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert float(ended.stdout.split()[0]) < 0.2


def test_the_two_commands_are_what_ci_and_the_demonstration_run() -> None:
    setup, tests = blocks("sh")[:2]
    assert setup.splitlines()[-1].endswith(".venv/bin/urdfcal demo")
    assert tests.splitlines()[-1] in (README.parent / ".ci" / "run").read_text()
