"""The texts of a recording: the table of DH rows, and what the sightings could not tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urdfcal.output.fastening import MOUNTS
from urdfcal.output.fitted import LENGTHS
from urdfcal.robot.tree_dh import MOUNT

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from urdfcal.output.findings import ResultData


def parameter_text(document: ResultData) -> str:
    """The DH rows as a table in Markdown, nominal value and offset ± standard deviation, and what was held and why."""
    entries: Sequence[Mapping[str, Any]] = document["dh"]
    names = list(dict.fromkeys(entry["parameter"] for entry in entries))
    columns = [f"{name} [{'mm' if name in LENGTHS else 'mrad'}]" for name in names]
    lines = [f"| row | joint | {' | '.join(columns)} |", f"|---|---|{'---|' * len(columns)}"]
    for number, first in enumerate(range(0, len(entries), len(names)), start=1):
        row = entries[first : first + len(names)]
        lines.append(f"| {number} | {row[0]['joint']} | {' | '.join(map(_cell, row))} |")
    lost = document["identifiability"]["lost"]
    text = "\n".join(lines)
    text += f"\n\n{MOUNTS}" if any(entry["joint"].endswith(MOUNT) for entry in entries) else ""
    text += "\n\n**What could not be told:**\n" + "\n".join(f"- {sentence}" for sentence in lost) if lost else ""
    held: dict[str, list[str]] = {}
    for entry in entries:
        if entry["status"] == "fixed" and entry["reason"] not in lost:
            held.setdefault(entry["reason"], []).append(f"{entry['joint']}.{entry['parameter']}")
    if held:
        text += "\n\n**Not estimated:**\n" + "\n".join(f"- {', '.join(which)}: {why}" for why, which in held.items())
    condition = document["identifiability"]["condition_number"]
    return f"{text}\n\nCondition number {condition:.3g} (above 100 some parameters are told badly).\n"


def _cell(entry: Mapping[str, Any]) -> str:
    nominal = f"{round(1e3 * entry['nominal'], 3) + 0.0:.3f}"
    if entry["status"] == "fixed":
        return nominal
    return f"{nominal} **{1e3 * entry['offset']:+.3f}** ± {1e3 * entry['sigma']:.3f}"
