"""Whether the intervals are true.

    python tests/benchmarks/coverage.py [--runs 300] [--poses 20] [--rig ur5]

Robots are drawn from the tolerances that act as priors, LEDs from their sigma; poses, cameras and noise are the rig's.
Prints how often 95 % intervals of the parameters and of the tip's error hold the truth (93 ... 97 % is right).
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from tests.states import state_of
from urdfcal.estimation.blocks.arm import ARM, no_offsets
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.model_spec import ModelSpec, nominal
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.estimation.uncertainty import tip_covariance
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.simulation.simulate import simulate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--rig", default="ur5")
    arguments = parser.parse_args()
    rig = read_rig(find_rig(arguments.rig))
    table = DHTable.from_chain(rig.chain)
    spec = ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2)
    q = rig.chain.random_values(200, np.random.default_rng(0))
    inside, tips, chi2 = [], [], []
    for run in range(arguments.runs):
        rng = np.random.default_rng([1, run])
        # Poses anew now and then: they cost more than a calibration.
        if run % 10 == 0:
            simulated = simulate(rig, poses=arguments.poses, seed=run, error_scale=0.0)
        session, truth = simulated.session, simulated.truth
        leds, views = np.array([led.position for led in session.leds]), np.array(session.rig.T_cam_world)
        start = state_of(session, np.zeros((len(table.rows), 5)), truth.T_world_base, leds, views)
        exactly = Problem.of(replace(session, q=truth.q), table)
        (block,) = exactly.observations
        parameters = identify(exactly, start, choose_parameters(session, exactly, start, spec)).parameters
        drawn = np.where(np.isfinite(parameters.prior), parameters.prior, 0.0)[parameters.active]
        true = parameters.retract(start, drawn * rng.standard_normal(parameters.count))
        uv = block.by_row(exactly.predict(block, true)) + rng.normal(0.0, session.noise.pixel, (block.count, 2))
        readings = truth.q + rng.normal(0.0, session.noise.joint, truth.q.shape)
        measured = replace(session, q=readings, measurements=(replace(session.find(Detections), uv=uv),))

        problem = Problem.of(measured, table)
        state = first_state(measured, table, no_offsets(problem.arm))
        base = choose_parameters(measured, problem, state, nominal(measured, state))
        state = solve(problem, state, base).state
        found = identify(problem, state, choose_parameters(measured, problem, state, spec))
        fit = solve(problem, state, found.parameters)

        sigma = fit.parameters.sigmas(fit.covariance)[fit.parameters.columns(ARM)]
        error = [(fit.state[ARM] - true[ARM])[row, PARAMETERS.index(name)] for row, name in table.parameters]
        known = np.isfinite(sigma)
        inside += (np.abs(error)[known] < 1.959964 * sigma[known]).tolist()
        covariance = tip_covariance(problem, fit, q)
        arms = (replace(rig.chain, placements=table.placements(s[ARM])) for s in (true, fit.state))
        position = compare(*arms, q).position
        # The error's length against its own predicted distribution, by simulation of the covariance.
        sample = np.random.default_rng(run).standard_normal((400, 3))
        for k in range(0, len(q), 10):
            lengths = np.linalg.norm(sample @ np.linalg.cholesky(covariance[k] + 1e-18 * np.eye(3)).T, axis=1)
            tips.append(position[k] < np.percentile(lengths, 95))
        chi2.append(fit.reduced_chi2)
    print(f"{arguments.rig}, {arguments.runs} runs of {arguments.poses} poses")
    print(f"parameters inside their 95 % interval   {100 * np.mean(inside):.1f} %")
    print(f"tip error inside its 95 % interval      {100 * np.mean(tips):.1f} %")
    print(f"reduced chi-square, mean                {np.mean(chi2):.3f}")


if __name__ == "__main__":
    main()
