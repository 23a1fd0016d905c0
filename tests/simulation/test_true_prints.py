from __future__ import annotations

from dataclasses import replace

import numpy as np

from urdfcal.estimation.blocks.targets import bend_key, print_key
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.simulation.simulate import simulate


def test_an_estimate_finds_prints_as_they_came_out() -> None:
    rig = read_rig(find_rig("ur5_charuco"))
    printed = replace(rig, targets=tuple(replace(target, flatness=2e-3, scale_sigma=2e-2) for target in rig.targets))
    data = simulate(printed, poses=30, seed=0)
    (true,), fit = data.truth.prints, calibrate(data.session, force=True).fit
    sigmas = fit.parameters.sigmas(fit.covariance)
    for key, value in ((print_key("board"), [true.given_too_long]), (bend_key("board"), true.bends)):
        sigma = sigmas[fit.parameters.columns(key)]
        assert np.all(np.abs(fit.state[key] - value) < 4.0 * sigma)
        assert np.linalg.norm(value) > 5.0 * np.linalg.norm(sigma)  # of the other sign it would be ten off


def test_prints_of_which_nothing_is_said_are_as_given() -> None:
    (of,) = simulate(read_rig(find_rig("ur5_charuco")), poses=3, seed=0).truth.prints
    assert of.as_given
