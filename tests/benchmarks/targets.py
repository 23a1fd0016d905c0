"""How well a board or a tag before one camera calibrates an arm, images included, and beside OpenCV's hand-eye.

    python -m tests.benchmarks.targets [--seeds 3] [--poses 40] [--rigs ur5_charuco ...] [--opencv PYTHON]

For every rig and seed: simulate, render, detect, calibrate.

- noise: rms of detected minus true points;
- tip: rms error over the workspace after base alignment, beside the Cramer-Rao bound (no priors) with that noise;
- held out: reprojection rms on every fourth pose, from the others: of the calibrated arm, of the nominal arm with
  target and camera estimated, and of OpenCV's calibrateHandEye and calibrateRobotWorldHandEye, by the best of their
  methods each, on the same detections and with the true lens. OpenCV 5's Python has lost both: PYTHON is of an
  environment with ``opencv-python-headless<5``.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.benchmarks.accuracy import information_of
from tests.benchmarks.cameras import tip_error as true_error
from tests.states import true_state_of
from urdfcal.arrays import inverse
from urdfcal.detection.detect import detect, write_detected
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.target_start import mean_pose, picture_poses
from urdfcal.estimation.uncertainty import tip_error
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Estimate
from urdfcal.simulation.images import TRUTH, Exposure, write_simulated_images
from urdfcal.simulation.simulate import simulate

# Of A_k X = Z B_k: calibrateHandEye's Z, and calibrateRobotWorldHandEye's X and Z, by every method.
OPENCV = """
import sys, cv2, numpy as np
data = np.load(sys.argv[1])
A, B, found = data["A"], data["B"], []
def T(R, t):
    M = np.eye(4); M[:3, :3] = R; M[:3, 3] = np.ravel(t); return M
R, t = list(A[:, :3, :3]), list(A[:, :3, 3])
back = np.linalg.inv(B)
for method in range(5):
    Z = T(*cv2.calibrateHandEye(list(back[:, :3, :3]), list(back[:, :3, 3]), R, t, method=method))
    found.append((np.full((4, 4), np.nan), np.linalg.inv(Z)))
for method in range(2):
    X = cv2.calibrateRobotWorldHandEye(R, t, list(B[:, :3, :3]), list(B[:, :3, 3]), method=method)
    found.append((T(*X[:2]), T(*X[2:])))
np.save(sys.argv[2], np.array(found))
"""


def bound(calibration, simulated, noise: float) -> float:
    """The tip's Cramer-Rao bound with a noise of the points that were detected. [mm]"""
    session = calibration.session
    session = replace(session, measurements=(session.find(Detections).with_noise({"pixel": noise}),))
    truth = true_state_of(replace(simulated, session=session))
    problem = Problem.of(session, calibration.geometry)
    camera = "free" if session.mounts else "fixed"
    spec = ModelSpec("dh", ("fixed",), (camera,), priors=False)
    parameters = identify(problem, truth, choose_parameters(session, problem, truth, spec)).parameters
    information = information_of(problem, truth, parameters)
    fit = replace(calibration.fit, state=truth, parameters=parameters, information=information, cost=0.0, doubt=None)
    return 1e3 * tip_error(problem, fit)[0]


def reprojection(session, A: np.ndarray, poses: np.ndarray) -> float:
    """Rms, per coordinate, of a target at T_cam_target (K, 4, 4) at some poses from where it was detected. [px]"""
    detections, (camera,) = session.find(Detections), session.rig.cameras
    squares = []
    for T, pose in zip(A, poses, strict=True):
        mine = detections.pose == pose
        p = session.targets[0].points[detections.led[mine]] @ T[:3, :3].T + T[:3, 3]
        squares.append(np.ravel(camera.project(p) - detections.uv[mine]) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def held_out(session, python: str | None) -> list[float]:
    """Reprojection on poses left out: the calibrated arm, the nominal one, OpenCV's two. [px]"""
    detections, (lens,) = session.find(Detections), session.rig.cameras
    seen = np.unique(detections.pose)
    test = seen[::4]
    train = np.setdiff1d(seen, test)
    results = []
    for geometry in (None, "none"):
        fit = calibrate(replace(session, estimate=Estimate(geometry)).at(train), force=True)
        rest = replace(session, measurements=(detections.rows(np.isin(detections.pose, test)),))
        problem = Problem.of(rest, fit.geometry)
        (observed,) = problem.observations
        residual = problem.residual(observed, fit.fit.state)[observed.valid]
        results.append(float(np.sqrt(np.mean(residual**2))))
    if python is None:
        return [*results, np.nan, np.nan]
    points = session.targets[0].points[detections.led]
    pictures, hypotheses = picture_poses(lens, detections.pose, points, detections.uv)
    A = hypotheses[:, 0]
    # A_k X = Z B_k with X = T_target_carrier and Z = T_cam_carrier; B is what the arm does between the two.
    B = tip_poses(session.chain, session.q)[pictures]
    if session.mounts:
        B = inverse(B)
    used = np.isin(pictures, train)
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / name) for name in ("in.npz", "out.npy")]
        np.savez(files[0], A=A[used], B=B[used])
        subprocess.run([python, "-c", OPENCV, *files], check=True)
        found = np.load(files[1])
    errors = []
    for X, Z in found:
        if not np.isfinite(Z).all():
            errors.append(np.inf)
            continue
        back = mean_pose(inverse(Z @ B[used]) @ A[used]) if np.isnan(X).any() else inverse(X)
        errors.append(reprojection(session, (Z @ B @ back)[~used], pictures[~used]))
    return [*results, min(errors[:5]), min(errors[5:])]


def run(name: str, seed: int, poses: int, python: str | None) -> list[float]:
    simulated = simulate(read_rig(find_rig(name)), poses=poses, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "session"
        write_simulated_images(place, simulated, Exposure())
        write_detected(place, detect(place))
        session = read_session(place)
        with (place / TRUTH).open() as file:
            true = {(row["pose"], row["led"]): (float(row["u"]), float(row["v"])) for row in csv.DictReader(file)}
    seen = session.find(Detections)
    keys = [(session.poses[pose], session.led_names[led]) for pose, led in zip(seen.pose, seen.led, strict=True)]
    off = seen.uv - np.array([true[key] for key in keys])
    noise = float(np.sqrt(np.mean(off**2)))
    calibration = calibrate(session)
    return [
        len(seen) / len(true),
        noise,
        float(np.sqrt(np.mean((off / seen.sigma[:, None]) ** 2))),
        true_error(calibration, simulated, seed),
        bound(calibration, simulated, noise),
        *held_out(session, python),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--poses", type=int, default=40)
    parser.add_argument("--rigs", nargs="*", default=["ur5_charuco", "panda_handeye", "so101_apriltag"])
    parser.add_argument("--opencv", help="Python with opencv-python-headless<5")
    arguments = parser.parse_args()
    columns = ("found", "noise", "off/sigma", "tip mm", "bound mm", "held out", "nominal", "HandEye", "RobotWorld")
    print(f"{'rms over seeds':16}" + "".join(f"{column:>11}" for column in (*columns, "tip/bound")))
    for name in arguments.rigs:
        rows = [run(name, seed, arguments.poses, arguments.opencv) for seed in range(arguments.seeds)]
        row = np.sqrt(np.mean(np.square(rows), axis=0))
        print(f"{name:16}" + "".join(f"{value:11.4f}" for value in (*row, row[3] / row[4])), flush=True)


if __name__ == "__main__":
    main()
