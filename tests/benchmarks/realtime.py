"""Microseconds that the kinematics for control loops take.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/realtime.py

Asked for: forward and Jacobian at most 20 us, inverse at most 80 us from 20 mrad away and 150 us (median) from 0.2 rad.
Each call's time is the best of five, which leaves out what other processes take.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from urdfcal import RealtimeKinematics
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig

if TYPE_CHECKING:
    from collections.abc import Callable

COUNT = 400


def microseconds(call: Callable[..., object], *of: object) -> float:
    best = np.inf
    for _ in range(5):
        began = time.perf_counter()
        call(*of)
        best = min(best, time.perf_counter() - began)
    return 1e6 * best


def main() -> None:
    print(f"{'arm':8} {'forward':>8} {'jacobian':>9}   inverse: median, 95 %, share found from 20 mrad | 0.2 rad")
    for rig in ("ur5", "panda", "so101"):
        chain, rng = read_rig(find_rig(rig)).chain, np.random.default_rng(0)
        arm = RealtimeKinematics(chain)
        lower, upper = np.maximum(chain.limits[0], -2.9), np.minimum(chain.limits[1], 2.9)
        q = lower + (upper - lower) * rng.uniform(0.1, 0.9, (COUNT, len(lower)))
        forward = np.median([microseconds(arm.forward, one) for one in q])
        jacobian = np.median([microseconds(arm.jacobian, one) for one in q])
        parts = []
        for away in (0.02, 0.2):
            near = rng.normal(size=q.shape)
            near = q + away * near / np.linalg.norm(near, axis=1)[:, None]
            tasks = [(arm.forward(one), start) for one, start in zip(q, near, strict=True)]
            took = [microseconds(arm.inverse, *task) for task in tasks]
            found = np.mean([arm.inverse(*task) is not None for task in tasks])
            parts.append(f"{np.median(took):6.1f} {np.percentile(took, 95):6.1f} {found:6.1%}")
        print(f"{rig:8} {forward:8.1f} {jacobian:9.1f}   {' | '.join(parts)}")


if __name__ == "__main__":
    main()
