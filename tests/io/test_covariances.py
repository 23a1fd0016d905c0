"""Full covariances of a tracker's points: read, written, used, and refused where they are none."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io.making import write_points
from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.arm import ARM, no_offsets
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.measurements import Points
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.estimation.measurements.points import SPREAD, CorrelatedPoints
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.io.folder import read_session
from urdfcal.io.writing import write_session
from urdfcal.robot.tree_dh import rows_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A tracker's session whose points are known four times worse along x, and x and y err together."""
    folder = write_points(tmp_path / "session")
    rows = (folder / "points.csv").read_text().split()
    cells = "1.6e-7,2e-9,0,1e-8,0,1e-8"
    (folder / "points.csv").write_text(
        "\n".join([f"{rows[0]},{','.join(SPREAD)}", *(f"{row},{cells}" for row in rows[1:])])
    )
    return folder


def test_they_are_read_and_whiten_the_residuals(folder: Path) -> None:
    session = read_session(folder)
    (table,) = session.measurements
    assert isinstance(table, CorrelatedPoints)
    expected = np.array([[1.6e-7, 2e-9, 0.0], [2e-9, 1e-8, 0.0], [0.0, 0.0, 1e-8]])
    np.testing.assert_array_equal(table.covariances, np.broadcast_to(expected, table.covariances.shape))
    (observed,) = Problem.of(session, rows_of(session.chain)).observations
    np.testing.assert_array_equal(observed.covariance[observed.valid], table.covariances)


def test_what_is_written_reads_back_to_the_last_bit(simulated: Callable, tmp_path: Path) -> None:
    session = simulated("stanford", poses=8).session
    session = replace(session, measurements=(triangulate(session),))
    write_session(tmp_path / "out", session)
    head = (tmp_path / "out" / "points.csv").read_text().splitlines()[0]
    assert head == f"pose,led,x,y,z,{','.join(SPREAD)}"
    (found,), (table,) = read_session(tmp_path / "out").measurements, session.measurements
    symmetric = np.triu(table.covariance) + np.swapaxes(np.triu(table.covariance, 1), 1, 2)
    np.testing.assert_array_equal(found.covariance, symmetric)
    np.testing.assert_array_equal(found.xyz, table.xyz)


def test_they_are_worth_more_than_one_number(simulated: Callable) -> None:
    """Triangulated points are many times worse along the view: with one sigma for all the arm comes out worse."""
    data = simulated("ur5", poses=30)
    session, table, errors = data.session, triangulate(data.session), []
    rows = rows_of(session.chain)
    truth = session.chain.with_placements(rows.placements(data.truth.offsets))
    q = session.chain.random_values(300, np.random.default_rng(0))
    for of in (table, Points(table.pose, table.led, table.xyz, np.array(np.median(table.sigma)))):
        some = replace(session, measurements=(of,))
        problem = Problem.of(some, rows)
        start = first_state(some, rows, no_offsets(rows))
        fit = solve(problem, start, choose_parameters(some, problem, start, ModelSpec("dh")))
        found = session.chain.with_placements(rows.placements(fit.state[ARM]))
        errors.append(np.sqrt(np.mean(compare(truth, found, q).position ** 2)))
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda text: text.replace(",szz", ",sigma", 1),
            r"points.csv:1: the columns are missing: szz.*Write sigma, or",
        ),
        (
            lambda text: "\n".join(f"{row},{'sigma' if k == 0 else '1e-4'}" for k, row in enumerate(text.split())),
            r"points.csv:1: sigma and a covariance say the same",
        ),
        (
            lambda text: text.replace("1.6e-7,2e-9", "1.6e-7,1e-7", 1),
            r"points.csv:2:\d+: the covariance is not positive definite.*m\^2",
        ),
        (lambda text: text.replace("1.6e-7", "", 1), r"points.csv:2:\d+: sxx: the cell is empty"),
        (
            lambda text: text.replace("1.6e-7,2e-9,0,1e-8,0,1e-8", "160,0,0,10,0,10", 1),
            r"points.csv:2:\d+: a sigma of .* is of the size of the arm.*or a covariance in its square",
        ),
    ],
)
def test_what_is_no_covariance_is_refused(folder: Path, change: Callable[[str], str], message: str) -> None:
    path = folder / "points.csv"
    text = path.read_text()
    path.write_text(change(text))
    assert path.read_text() != text
    with pytest.raises(SessionError) as caught:
        read_session(folder)
    assert re.search(message, str(caught.value))
