from __future__ import annotations

import pytest

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.findings import claims, fastening_sentences, listed


@pytest.mark.parametrize("rig", ["ur5", "stanford"])
def test_what_goes_without_saying_is_not_said(rig):
    assert fastening_sentences(read_rig(find_rig(rig))) == ()


@pytest.mark.parametrize(
    ("rig", "said"),
    [
        ("tiago", ("LEDs: left, right and front on arm_tool_link.", "head is on xtion", "about arm_tool_link")),
        ("tiago_dual", ("left on arm_left_tool_link; right on arm_right_tool_link", "about arm_left_tool_link")),
        ("ur5_handeye", ("a, b, c and d fixed in the world", "hand is on tool0", "on its ray")),
    ],
)
def test_what_is_fastened_to_what_is_said(rig, said):
    text = " ".join(fastening_sentences(read_rig(find_rig(rig))))
    for part in said:
        assert part in text
    assert ("Camera" in text) == (rig != "tiago_dual")


def test_lists_read_like_sentences():
    assert [listed(["a", "b", "c"][:k]) for k in (1, 2, 3)] == ["a", "a and b", "a, b and c"]


def said_of(
    more, poses=30, cameras=("left",), left_out=None, size=None, moving=False, held_out=0.2, regions=0.2,
    tips=("tool",), joints=(("shoulder", "revolute"),), **scale
):  # fmt: skip
    """What is said of the tip, of a result with some of its keys."""
    scale = {"tip_mm_per_permille": 0.5, "factor_sigma": None, "declared_sigma": None, **scale}
    tip = {"rms_mm": 0.21, "interval_mm": [0.1, 0.3], "more": more, "size": size}
    fit = {"poses": poses, "reduced_chi2": 4.0}
    document = {
        "robot": {
            "tip_link": "tool",
            "tips": dict.fromkeys(tips),
            "joints": {name: {"type": of} for name, of in joints},
        },
        "tip": tip,
        "regions": {"rms_mm": regions},
        "scale": scale,
        "fit": fit,
        "cameras": {name: {"time_offset": {}} if moving else {} for name in cameras},
    }
    document["validation"] = {"rms_mm": held_out, "left_out": left_out, "folds": 5}
    return claims(document)


def test_what_more_poses_would_bring_is_said_or_that_the_model_is_the_limit():
    assert said_of({"poses": 5, "rms_mm": 0.19})[-1] == (
        "5 more poses like these would bring 0.21 -> 0.19 mm; urdfcal plan finds better poses"
    )
    assert said_of({"poses": 60, "rms_mm": 0.15}, poses=60, cameras=())[-1] == (
        "as many poses again like these would bring 0.21 -> 0.15 mm"
    )
    assert said_of({"poses": 5, "rms_mm": None})[-1] == (
        "the model is the limit, not the poses: the residuals are 2 times the declared noise"
    )
    assert said_of({"poses": 60, "rms_mm": None}, moving=True)[-1].startswith("the model is the limit, not the frames")
    assert len(said_of(None)) == 3  # results of earlier versions
    found = {"poses": 4, "rms_mm": 0.33, "max_mm": 0.51}
    assert said_of(None, left_out=found)[-1] == "0.33 mm rms, at most 0.51, in the 4 poses left out"


def test_where_the_size_of_the_arm_is_the_limit_a_known_length_is_asked_for_and_no_poses():
    size = {"sigma": 1.54e-3, "rms_mm": 0.2, "rms_without_mm": 0.05, "is_limit": True}
    said = said_of({"poses": 60, "rms_mm": 0.2097}, poses=60, size=size)
    assert said[-3] == (
        "0.2 mm of it is one factor of all lengths, known to 0.15 %: a better known length would bring 0.21 -> 0.05 mm"
    )
    assert said[-2] == "if the scale is right: 0.1 % of it is 0.5 mm at the tip", "whatever else is the limit"
    assert said[-1] == "as many poses again like these would bring next to nothing"
    assert len(said_of(None, size={**size, "is_limit": False})) == 3
    assert len(said_of(None, size={**size, "rms_without_mm": 0.2101})) == 3, "it would bring nothing"


def test_of_few_poses_it_is_said_that_held_out_ones_are_by_fewer_still():
    assert "its noise included, from about 8 of the 10 poses at a time; 0.2 mm where" in said_of(None, poses=10)[0]
    assert "at a time" not in said_of(None, poses=30)[0]


def test_a_tip_error_far_beyond_what_held_out_poses_show_is_explained():
    assert len(said_of(None, held_out=0.05)) == 3, "regions left out do show it"
    assert said_of(None, held_out=0.05, regions=0.06)[2].startswith("4 times what held-out poses show")


@pytest.mark.parametrize(
    ("scale", "sentence"),
    [
        ({}, "if the scale is right: 0.1 % of it is 0.5 mm at the tip"),
        ({"factor": -1e-3, "factor_sigma": 2e-3}, "; the nominal arm's lengths differ from it by -0.1 ± 0.2 %"),
        ({"factor": 1e-4, "factor_sigma": 2e-3, "declared_sigma": 5e-3}, "; it comes out off by +0.01 ± 0.2 %"),
        ({"unit": "distances"}, "if the known distances are right: 0.1 % of them is 0.5 mm at the tip"),
        ({"tip_mm_per_permille": 0.0}, "lengths are those of the nominal arm within its tolerances"),
    ],
)
def test_what_the_error_is_conditional_on_is_said(scale, sentence):
    assert sentence in said_of(None, **scale)[2]


def test_a_sliding_joint_is_a_length_too():
    said = said_of(None, joints=(("lift", "prismatic"), ("shoulder", "revolute")), factor=1e-4, factor_sigma=3e-4)
    assert "; the nominal arm's lengths and the readings of lift differ from it by +0.01 ± 0.03 %" in said[2]


def test_a_scale_that_moves_the_tip_by_rounding_alone_is_none():
    assert any("within its tolerances" in text for text in said_of(None, tip_mm_per_permille=1.4e-15))


def test_of_several_arms_the_one_that_is_meant_is_named():
    assert any(text.startswith("tip 0.21 mm rms") for text in said_of(None))
    assert any(text.startswith("tip tool 0.21 mm rms") for text in said_of(None, tips=("tool", "other")))
