from __future__ import annotations

import pytest

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.findings import fastening_sentences, listed


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
