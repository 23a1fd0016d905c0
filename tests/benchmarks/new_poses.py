"""Whether `urdfcal verify` tells from few poses what an arm's error is in many.

    python -m tests.benchmarks.new_poses [--arms 12] [--draws 10] [--poses 8 10 12 20 40]

For every rig, the nominal arm (its own errors count) and the true one (only noise does), and every number of poses
drawn out of 100: the median of the rms over that in all 100 poses, and how often the latter is in the 95 % interval,
above it (an arm too bad would pass) and below it.

Without making up for what the fit took away, the bootstrap's intervals would hold it in 42 % of the draws of 6 poses,
and in 85 % of those of 12 (nominal ur5).
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from urdfcal.estimation.acceptance import accept
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.simulate import simulate

POSES = 100


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=12)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--poses", type=int, nargs="*", default=[8, 10, 12, 20, 40])
    parser.add_argument("--rigs", nargs="*", default=["ur5", "panda", "so101"])
    arguments = parser.parse_args()
    print(f"{'rig':8}{'arm':9}{'poses':>5}{'rms ratio':>11}{'within':>8}{'above':>7}{'below':>7}")
    for name in arguments.rigs:
        rig = read_rig(find_rig(name))
        data = [simulate(rig, poses=POSES, seed=seed, pixel=0.1) for seed in range(arguments.arms)]
        for arm in ("nominal", "true"):
            found: dict[int, list[tuple[float, float, float]]] = {count: [] for count in arguments.poses}
            for seed, of in enumerate(data):
                session, rng = of.session, np.random.default_rng(seed)
                chain = session.chain if arm == "nominal" else replace(session.chain, placements=of.truth.placements)
                all_poses = accept(chain, session, 1.0).rms
                for count in arguments.poses:
                    for _ in range(arguments.draws):
                        few = session.at(np.sort(rng.choice(POSES, count, replace=False)))
                        judged = accept(chain, few, 1.0)
                        found[count].append((judged.rms / all_poses, *(end / all_poses for end in judged.interval)))
            for count, rows in found.items():
                ratio, low, high = np.array(rows).T
                shares = np.mean([(low <= 1.0) & (high >= 1.0), high < 1.0, low > 1.0], axis=1)
                print(f"{name:8}{arm:9}{count:5}{np.median(ratio):11.2f}", end="")
                print(f"{shares[0]:8.2f}{shares[1]:7.2f}{shares[2]:7.2f}", flush=True)


if __name__ == "__main__":
    main()
