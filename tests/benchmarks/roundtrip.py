"""Every serial chain of example-robot-data: rows, corrections, URDF, and back.

    python tests/benchmarks/roundtrip.py [--configurations 100]

For each chain: FK of the DH rows against Pinocchio; the URDF after no correction (must be the same bytes) and after
random corrections of 1 and 10 mm and mrad, read again by Pinocchio and by yourdfpy, against the corrected rows.
Prints the largest differences.
"""

from __future__ import annotations

import argparse
import io

import numpy as np
import pinocchio as pin
import yourdfpy

from urdfcal.errors import RobotError
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.origins import origins_of, rewrite_origins
from urdfcal.robot.urdf.packages import package_roots
from urdfcal.robot.urdf.urdf import Urdf


def chains() -> list[tuple[Urdf, str, str]]:
    found = []
    for path in sorted((package_roots()[-1] / "example-robot-data" / "robots").rglob("*.urdf")):
        try:
            urdf = Urdf.read(path)
        except RobotError as error:
            print(f"not read: {error}")
            continue
        model = pin.buildModelFromXML(urdf.data.decode())
        links = {frame.parentJoint: frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
        parents = list(model.parents)
        for leaf in sorted(set(range(1, model.njoints)) - set(parents[1:])):
            found.append((urdf, urdf.root, links[leaf]))
            above = parents[parents[leaf]] or parents[leaf]
            if above and len(found) % 5 == 0:  # and some whose base is inside the tree
                found.append((urdf, urdf.joints[model.names[above]].child, links[leaf]))
    return found


def yourdfpy_tips(data: bytes, chain: Chain, q: np.ndarray) -> np.ndarray:
    robot = yourdfpy.URDF.load(io.BytesIO(data), load_meshes=False, build_scene_graph=True)
    tips = []
    for values in q:
        by_name = dict(zip(chain.names, values, strict=True))
        robot.update_cfg([by_name.get(joint.name, 0.0) for joint in robot.actuated_joints])
        tips.append(robot.get_transform(chain.tip_link, chain.base_link))
    return np.array(tips)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--configurations", type=int, default=100)
    configurations = parser.parse_args().configurations
    rng = np.random.default_rng(0)
    worst = {"rows against Pinocchio": 0.0, "URDF by Pinocchio": 0.0, "URDF by yourdfpy": 0.0}
    done, refused, mimic, inner = 0, 0, 0, 0
    for urdf, base, tip in chains():
        try:
            chain = Chain.from_urdf(urdf, tip, base)
        except RobotError as error:
            if "mimics" not in str(error):
                raise
            refused += 1
            continue
        done += 1
        inner += base != urdf.root
        table = DHTable.from_chain(chain)
        readings = rng.uniform(-3.0, 3.0, (configurations, len(chain.actuated)))
        q = chain.joint_values(readings)
        expected = tip_poses(chain, q)
        rows = np.array([table.forward(q_k) for q_k in q])
        worst["rows against Pinocchio"] = max(worst["rows against Pinocchio"], np.abs(rows - expected).max())
        if rewrite_origins(urdf, origins_of(urdf, chain, table.placements(np.zeros((len(q[0]), 5))))) != urdf.data:
            raise SystemExit(f"{urdf.path} {tip}: no correction changed the file")
        for scale in (1e-3, 1e-2):
            offsets = rng.normal(0.0, scale, (len(table.rows), 5))
            offsets[-1, np.arange(5) != PARAMETERS.index(table.rows[-1].variable)] = 0.0
            data = rewrite_origins(urdf, origins_of(urdf, chain, table.placements(offsets)))
            corrected = np.array([table.forward(q_k, offsets) for q_k in q[:10]])
            again = tip_poses(Chain.from_urdf(Urdf.parse(data), tip, base), q[:10])
            worst["URDF by Pinocchio"] = max(worst["URDF by Pinocchio"], np.abs(again - corrected).max())
            if any(joint.mimic for joint in chain.joints):
                mimic += 1  # yourdfpy computes mimic joints itself, not always from the same joint
                continue
            again = yourdfpy_tips(data, chain, q[:10])
            worst["URDF by yourdfpy"] = max(worst["URDF by yourdfpy"], np.abs(again - corrected).max())
    print(
        f"{done} chains, {inner} of them with a base inside the tree, {mimic // 2} with mimic joints; "
        f"{refused} refused because a joint mimics one that is off the chain"
    )
    for what, difference in worst.items():
        print(f"{what:24} {difference:.1e} (m, or entries of the rotation)")


if __name__ == "__main__":
    main()
