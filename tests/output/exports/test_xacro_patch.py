from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import xacro

from urdfcal.output.exports.tables import xacro_patch
from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from pathlib import Path

    from tests.output.exports.conftest import Result


def test_xacro_makes_the_calibrated_robot_by_the_instruction(result: Result, tmp_path: Path) -> None:
    ((name, text),) = xacro_patch(result.calibration).items()
    (tmp_path / name).write_text(text)
    comments = [line.removeprefix("#").strip() for line in text.splitlines() if line.startswith("#")]
    (load,) = (line for line in comments if line.startswith("<xacro:property"))
    (origin,) = (line for line in comments if line.startswith("<origin"))
    last = result.calibration.chain.names[-1]
    source = result.urdf.data.decode()
    for joint in result.calibration.chain.names:
        block = re.search(rf'<joint [^>]*name="{joint}"[^>]*>.*?</joint>', source, re.DOTALL)[0]
        bare = re.sub(r"<origin[^>]*/>", "", block)
        source = source.replace(block, bare.replace("</joint>", f"{origin.replace(last, joint)}</joint>"))
    root = re.search(r"<robot [^>]*>", source)[0]
    declared = root if "xmlns:xacro" in root else f'{root[:-1]} xmlns:xacro="http://www.ros.org/wiki/xacro">'
    source = source.replace(root, declared + load)
    (tmp_path / "robot.xacro").write_text(source)
    made = xacro.process_file(str(tmp_path / "robot.xacro")).toxml(encoding="utf-8")
    chain = Chain.from_urdf(Urdf.parse(made), result.calibration.chain.tip_link, result.calibration.chain.base_link)
    q = chain.random_values(20, np.random.default_rng(0))
    np.testing.assert_allclose(tip_poses(chain, q), tip_poses(result.calibration.calibrated, q), rtol=0, atol=1e-9)
