"""Whether the intervals are true.

    python tests/benchmarks/coverage.py [--runs 300] [--poses 20] [--rig ur5]

Robots are drawn from the tolerances that act as priors, LEDs from their sigma; poses, cameras and noise are the rig's.
Prints how often 95 % intervals of the parameters and of the tip's error hold the truth (93 ... 97 % is right).
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.linearize import predict
from urdfcal.estimation.model_spec import Freedoms, nominal
from urdfcal.estimation.observations import observe
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.estimation.state import State
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
    freedoms = Freedoms("dh", ("fixed",) * 2, ("fixed",) * 2)
    q = rig.chain.random_values(200, np.random.default_rng(0))
    inside, tips, chi2 = [], [], []
    for run in range(arguments.runs):
        rng = np.random.default_rng([1, run])
        # Poses anew now and then: they cost more than a calibration.
        if run % 10 == 0:
            simulated = simulate(rig, poses=arguments.poses, seed=run, error_scale=0.0)
        session, truth = simulated.session, simulated.truth
        start = State(
            offsets=np.zeros((len(table.rows), 5)),
            T_world_base=truth.T_world_base,
            leds=np.array([led.position for led in session.leds]),
            cameras=session.rig.cameras,
            T_cam_world=np.array(session.rig.T_cam_world),
        )
        parameters = choose_parameters(session, table, start, freedoms)
        (block,) = observe(session)
        parameters = identify(table, [block], start, parameters).parameters
        drawn = np.where(np.isfinite(parameters.prior), parameters.prior, 0.0)[parameters.active]
        true = parameters.move(start, drawn * rng.standard_normal(parameters.count))
        exact = predict(table, replace(block, q=truth.q[block.pose]), true)
        uv = block.by_row(exact) + rng.normal(0.0, session.noise.pixel, (block.count, 2))
        readings = truth.q + rng.normal(0.0, session.noise.joint, truth.q.shape)
        measured = replace(session, q=readings, detections=replace(session.detections, uv=uv))

        blocks = observe(measured)
        state = first_state(measured, table, np.zeros_like(true.offsets))
        base = choose_parameters(measured, table, state, nominal(measured, state))
        state = solve(table, blocks, state, base, measured.noise.joint).state
        found = identify(table, blocks, state, choose_parameters(measured, table, state, freedoms))
        fit = solve(table, blocks, state, found.parameters, measured.noise.joint)

        sigma = np.full(fit.parameters.size, np.nan)
        sigma[fit.parameters.active] = np.sqrt(np.diag(fit.covariance))
        for index, (row, name) in enumerate(fit.parameters.rows):
            if np.isfinite(sigma[index]):
                error = fit.state.offsets[row, PARAMETERS.index(name)] - true.offsets[row, PARAMETERS.index(name)]
                inside.append(abs(error) < 1.959964 * sigma[index])
        covariance = tip_covariance(table, fit, q)
        arms = (replace(rig.chain, placements=table.placements(s.offsets)) for s in (true, fit.state))
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
