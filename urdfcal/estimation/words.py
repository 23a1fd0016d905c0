"""Lost directions in sentences that a mechanic understands."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.estimation.parameters import Geometry, Parameters

_LENGTHS = ("d", "a", "x", "y", "z")
_NAMED = 5


def sentence(table: Geometry, parameters: Parameters, victim: int, partners: Sequence[int], *, held: bool) -> str:
    """Say what cannot be told, from what, and what is done about it.

    Args:
        table: the arm's parameters.
        parameters: the packing.
        victim: full index of the parameter that stands for the lost direction.
        partners: full indices of what it is confused with, the largest share first.
        held: whether it is held as drawn; else tolerances share the direction out.
    """
    name = _name(table, parameters, victim)
    outcome = "it is held as drawn" if held else "their tolerances share it out"
    arm = [k for k in partners if k < len(parameters.rows)]
    base = [k for k in partners if parameters.base.start <= k < parameters.base.stop]
    leds = [k for k in partners if parameters.base.stop <= k < parameters.base.stop + 3 * parameters.leds]
    if not partners and victim >= parameters.clock(0).start:
        return f"{name} cannot be told: the arm does not move in that camera's frames; it is held as it is"
    if not partners:
        return f"{name} moves nothing that is seen (an LED on the last axis hides it): {outcome}"
    if _is_scale(parameters, victim, partners):
        return (
            f"the scale (all lengths together, {name} among them) cannot be told without a stereo baseline or a known "
            f"distance: {outcome}"
        )
    if not arm and len(base) == len(partners):
        return f"{name} cannot be told from where the robot stands (T_world_base): {outcome}"
    if not arm and len(leds) == len(partners):
        return f"{name} cannot be told from where the LEDs sit: {outcome}"
    cameras = [k for k in partners if parameters.camera(0).start <= k < parameters.lens(0).start]
    if len(cameras) == len(partners):
        named = " and ".join(sorted({parameters.names[k].rpartition(".")[0] for k in cameras}))
        return f"{name} cannot be told from where {named} is fastened: {outcome}"
    same = [k for k in arm if victim < len(parameters.rows) and parameters.rows[k][1] == parameters.rows[victim][1]]
    if same and len(same) == len(arm) and len(arm) == len(partners):
        others = " and ".join(_name(table, parameters, k) for k in same)
        return f"{name} and {others} only appear as a sum (their axes are parallel): {outcome}"
    named = ", ".join(_name(table, parameters, k) for k in partners[:_NAMED])
    more = f" and {len(partners) - _NAMED} more" if len(partners) > _NAMED else ""
    return f"{name} cannot be told from {named}{more}: {outcome}"


def _name(table: Geometry, parameters: Parameters, index: int) -> str:
    if index < len(parameters.rows):
        row, name = parameters.rows[index]
        return f"{name} of row {row + 1} ({table.labels[row]})"
    return parameters.names[index]


def _is_scale(parameters: Parameters, victim: int, partners: Sequence[int]) -> bool:
    """Whether lengths of the arm, of the LEDs and of the base's or a camera's place move, along more than one axis."""
    moving = (victim, *partners)
    lengths = all(parameters.names[k].rpartition(".")[2] in _LENGTHS for k in moving)
    leds = range(parameters.base.stop, parameters.base.stop + 3 * parameters.leds)
    on_leds = any(k in leds for k in moving)
    on_arm = any(k < len(parameters.rows) for k in moving)
    places = sum(k >= parameters.base.start and k not in leds for k in moving)
    return lengths and on_leds and on_arm and places > 1
