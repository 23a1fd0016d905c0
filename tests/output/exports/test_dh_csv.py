from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.errors import OutputError
from urdfcal.output.exports.tables import dh_csv
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable, row_transform
from urdfcal.robot.kinematics import tip_poses
from urdfcal.rotations import rpy_to_matrix
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.output.exports.conftest import Result

NAMES = ("theta", "d", "a", "alpha", "beta")


def test_the_rows_of_the_table_move_as_the_calibrated_arm(result: Result) -> None:
    rows, frames = (list(csv.DictReader(io.StringIO(text))) for text in dh_csv(result.calibration).values())
    T_of = {}
    for frame in frames:
        T = np.eye(4)
        T[:3, 3] = [float(frame[key]) for key in "xyz"]
        T[:3, :3] = rpy_to_matrix([float(frame[key]) for key in ("roll", "pitch", "yaw")])
        T_of[frame["frame"]] = T
    chain = result.calibration.calibrated
    q = chain.random_values(20, np.random.default_rng(0))
    tips = []
    for q_k in q:
        T = T_of["base"]
        for row, value in zip(rows, q_k, strict=True):
            variable = "d" if row["type"] == "prismatic" else "theta"
            T = T @ row_transform([float(row[name]) + value * (name == variable) for name in NAMES])
        tips.append(T @ T_of["tool"])
    np.testing.assert_allclose(tips, tip_poses(chain, q), rtol=0, atol=1e-9)


def test_offsets_and_sigmas_are_the_calibrations(result: Result) -> None:
    rows = list(csv.DictReader(io.StringIO(dh_csv(result.calibration)["dh.csv"])))
    values, offsets = (np.array([[float(row[n + end]) for n in NAMES] for row in rows]) for end in ("", "_offset"))
    np.testing.assert_allclose(values - offsets, DHTable.from_chain(result.calibration.chain).nominal, atol=1e-15)
    for entry in result.calibration.to_dict()["dh"]:
        row = next(row for row in rows if row["joint"] == entry["joint"])
        assert row[f"{entry['parameter']}_sigma"] == (repr(entry["sigma"]) if "sigma" in entry else "")


def test_whole_placements_are_no_rows(simulated: Callable) -> None:
    session = replace(simulated("elbow3r").session, estimate=Estimate(geometry="full"))
    with pytest.raises(OutputError, match="no DH rows"):
        dh_csv(calibrate(session))
