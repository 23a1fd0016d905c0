"""What planned poses bring, against as many, 1.7 and twice as many random ones, on true tip errors.

    python tests/benchmarks/planning.py [--seeds 20] [--rigs ur5 panda so101 tiago] [--start 8] [--planned 10]

Of every rig and seed an arm is simulated and measured in ``--start`` random poses. Then in ``--planned`` planned ones
more, in as many random ones, in 1.7 and in 2 x as many; true tip errors over the joints' ranges after base alignment.
What is expected is an rms over arms, above their median: by half where one direction decides, as a Tiago's scale.
Arms that so many poses are not found of are named and left out.
Asked for: the median no worse than with 1.7 x as many for each rig, and than with twice as many in the rigs' mean.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed

from tests.measuring import both, measured_at, true_error
from urdfcal.arrays import one_blas_thread
from urdfcal.errors import UrdfcalError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.planning.planner import Planner
from urdfcal.session.knowledge import Estimate
from urdfcal.simulation.simulate import simulate


def errors(name: str, seed: int, start: int, planned: int) -> dict[str, float] | str:
    """True tip errors [m] of one arm, by what was measured of it, and what was expected of the plan; or why none."""
    count = planned
    rig = read_rig(find_rig(name))
    with one_blas_thread():
        simulated = simulate(rig, seed=seed, poses=start + 2 * count, pixel=0.1)
        estimate = Estimate("dh", "fixed")  # cameras on links are refined, as they are where nothing is said
        every = replace(simulated.session, estimate=estimate)
        rng = np.random.default_rng(seed)
        # Its poses were chosen to be spread: in any order they are better than random ones that only must be seen.
        order = rng.permutation(len(every.poses))
        few = every.at(np.sort(order[:start]))
        try:
            plan = Planner(few).plan(count)
        except UrdfcalError as error:
            return f"{name} {seed}: {error}"
        if plan.count < count:
            return f"{name} {seed}: {plan.count} poses planned"
        q = plan.q[plan.rank >= 0]
        found = {}
        for what, session in (
            ("start", few),
            ("planned", both(few, replace(measured_at(simulated, q, seed), estimate=estimate))),
            ("random", every.at(np.sort(order[: start + count]))),
            ("1.7 x", every.at(np.sort(order[: start + 17 * count // 10]))),
            ("twice", every),
        ):
            found[what] = true_error(simulated, calibrate(session, force=True))
        found["expected"] = float(plan.errors[-1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rigs", nargs="*", default=["ur5", "panda", "so101", "tiago"])
    parser.add_argument("--start", type=int, default=8)
    parser.add_argument("--planned", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    columns = ["start", "planned", "random", "1.7 x", "twice", "expected"]
    print("median, mm   " + "".join(f"{column:>10}" for column in columns) + "   planned/1.7 x, planned/twice")
    ratios = []
    for name in arguments.rigs:
        tasks = (delayed(errors)(name, seed, arguments.start, arguments.planned) for seed in range(arguments.seeds))
        found = Parallel(n_jobs=arguments.processes)(tasks)
        rows = [row for row in found if not isinstance(row, str)]
        for trouble in (row for row in found if isinstance(row, str)):
            print(trouble)
        by = {column: np.array([1e3 * row[column] for row in rows]) for column in columns}
        median = {column: float(np.median(of)) for column, of in by.items()}
        ratios.append([median["planned"] / median[column] for column in ("1.7 x", "twice")])
        print(f"{name:12} " + "".join(f"{median[column]:10.4f}" for column in columns), end="")
        print(f"   {ratios[-1][0]:.3f} {ratios[-1][1]:.3f}", flush=True)
    worst, mean = max(ratio[0] for ratio in ratios), float(np.mean([ratio[1] for ratio in ratios]))
    print(f"worst rig {worst:.3f} of 1.7 x, mean of the rigs {mean:.3f} of twice")


if __name__ == "__main__":
    main()
