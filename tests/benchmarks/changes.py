"""How often `urdfcal compare` calls an arm changed that is the same, and whether it sees what has grown.

    python -m tests.benchmarks.changes [--pairs 20] [--poses 50] [--rigs ur5 panda so101] [--worlds rigid together]

For every rig, world (what is wrong with the joints) and arm: two sessions of other poses are calibrated and compared.
Printed: how many are called changed, by a parameter and by the tips, where at most 1 % each is promised, with the names
of those parameters; the tips' distance over what is expected at most, median and 95 %; and how many are called changed
where each of the world's effects, of one size in all joints, has doubled in the second session.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.result.calibration import Calibration
from urdfcal.result.changes import ArmChanges, find_changes
from urdfcal.result.document import ResultDocument
from urdfcal.simulation.simulate import simulate

# What all joints have in the first session of arms that wear, twice as much in the second.
SIZES = {"compliance": 3e-5, "eccentricity": 3e-4, "backlash": 3e-4, "lag": 2e-4, "gain": 3e-4}


def calibrated(rig: str, errors: dict[str, object], arm: int, session: int, poses: int) -> Calibration:
    described = replace(read_rig(find_rig(rig)), errors=errors)
    fitted = calibrate(simulate(described, poses=poses, seed=session, arm_seed=arm).session, force=True)
    return Calibration(ResultDocument.model_validate(fitted.to_dict()))


def compared(rig: str, errors: list[dict[str, object]], arm: int, poses: int) -> ArmChanges:
    first, second = (calibrated(rig, of, arm, 1000 + 2 * arm + k, poses) for k, of in enumerate(errors))
    return find_changes(first, second)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--rigs", nargs="*", default=["ur5", "panda", "so101"])
    parser.add_argument("--worlds", nargs="*", default=["rigid", *SIZES, "together"])
    arguments = parser.parse_args()
    for world in arguments.worlds:
        kinds = list(SIZES) if world == "together" else [] if world == "rigid" else [world]
        same = [dict.fromkeys(kinds, "default")] * 2
        worn = [{kind: factor * SIZES[kind] for kind in kinds} for factor in (1.0, 2.0)]
        for rig in arguments.rigs:
            found = [compared(rig, same, arm, arguments.poses) for arm in range(arguments.pairs)]
            names = Counter(f"{p.joint}.{p.parameter}" for changes in found for p in changes.significant)
            ratio = np.percentile([c.tip.rms / (c.expected or np.nan) for c in found], [50, 95])
            seen = [compared(rig, worn, arm, arguments.poses).changed for arm in range(arguments.pairs) if kinds]
            print(
                f"{world:12} {rig:8} same: changed {sum(c.changed for c in found)} of {len(found)}, by parameters "
                f"{sum(bool(c.significant) for c in found)}, by tips {sum(c.apart for c in found)}, tips / expected "
                f"{ratio[0]:.2f} {ratio[1]:.2f}; worn: seen {sum(seen)} of {len(seen)}; {dict(names.most_common(6))}",
                flush=True,
            )


if __name__ == "__main__":
    main()
