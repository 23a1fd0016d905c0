"""Whether intervals are true where an arm touches things, or is measured by a ball bar, and no camera looks.

    python -m tests.benchmarks.touching [--runs 60] [--poses 80]

Robots are drawn from the tolerances that act as priors, LEDs from their sigma. Prints for contacts, planes and
distances how often 95 % intervals of the parameters hold the truth (93 ... 97 % is right), and the tip's rms error as
drawn and calibrated.
"""

from __future__ import annotations

import argparse

import numpy as np

from tests.touching import KINDS, arm, touched
from urdfcal.estimation.blocks.arm import ARM, ArmBlock, no_offsets
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.robot.tree_dh import rows_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--poses", type=int, default=80)
    arguments = parser.parse_args()
    rig = arm()
    table, led = rows_of(rig.chain), rig.leds[0]
    q = rig.chain.random_values(300, np.random.default_rng(0))
    for kind in KINDS:
        inside, errors, chi2 = [], [], []
        for run in range(arguments.runs):
            rng = np.random.default_rng([2, run])
            session = touched(kind, arguments.poses, run).session
            problem = Problem.of(session, table)
            start = first_state(session, table, no_offsets(table))
            # Drawn in what is identifiable: the rest is the gauge's.
            free = identify(problem, start, choose_parameters(session, problem, start, ModelSpec("dh"))).parameters
            block = next(block for block in free.blocks if isinstance(block, ArmBlock))
            offsets = no_offsets(table)
            offsets[block.places] = block.sigma * rng.standard_normal(len(block)) * block.active
            place = np.array([led.position + led.sigma * rng.standard_normal(3)])
            data = touched(kind, arguments.poses, run, offsets=offsets, led=place)
            problem = Problem.of(data.session, table)
            start = first_state(data.session, table, no_offsets(table))
            base = choose_parameters(data.session, problem, start, ModelSpec("none"))
            state = solve(problem, start, base).state
            found = identify(problem, state, choose_parameters(data.session, problem, state, ModelSpec("dh")))
            fit = solve(problem, state, found.parameters)
            sigmas = fit.parameters.sigmas(fit.covariance)
            for key in (ARM, LEDS):
                sigma = sigmas[fit.parameters.columns(key)]
                error = fit.state[key] - data.truth[key]
                error = error[block.places] if key == ARM else error.ravel()
                known = np.isfinite(sigma)
                inside += (np.abs(error)[known] < 1.959964 * sigma[known]).tolist()
            arms = [rig.chain.with_placements(table.placements(of)) for of in (offsets, 0 * offsets, fit.state[ARM])]
            errors.append([np.sqrt(np.mean(compare(arms[0], other, q).position ** 2)) for other in arms[1:]])
            chi2.append(fit.reduced_chi2)
        drawn, calibrated = 1e3 * np.median(errors, axis=0)
        print(
            f"{kind.kind:10} {np.mean(inside):6.1%} of {len(inside)} parameters inside; tip {drawn:.2f} -> "
            f"{calibrated:.3f} mm (median); reduced chi-square {np.mean(chi2):.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
