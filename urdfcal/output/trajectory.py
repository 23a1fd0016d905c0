"""Joint trajectories as CSV: read with the columns they have, written again with other joint commands."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import SessionError
from urdfcal.io.csv_table import Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from urdfcal.robot.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class CommandTable:
    """A table of joint commands, and whatever else its columns hold.

    Attributes:
        table: its text.
        joints: the k columns that are commands of the chain's actuated joints, in the chain's order.
        q: (N, k) those commands. [rad or m]
    """

    table: Table
    joints: tuple[str, ...]
    q: Floats

    @classmethod
    def read(cls, path: Path, chain: Mechanism) -> CommandTable:
        """Read a trajectory.

        Args:
            path: a CSV file with a column of each actuated joint of the chain; other columns are kept as they are.
            chain: whose joints it commands.

        Raises:
            SessionError: the file cannot be read, a joint has no column, a command is no finite number or beyond the
                joint's limits, or a column commands a joint that follows another; with file, line and column.
        """
        table = Table.read(path, chain.actuated, ignored=None)
        for joint in chain.joints:
            if joint.mimic is not None and joint.name in table.columns:
                raise SessionError(
                    f"joint {joint.name!r} follows {joint.mimic.joint!r} and takes no commands",
                    where=f"{path}:1",
                    remedy="Leave its column out.",
                )
        q = frozen(table.numbers(chain.actuated))
        if outside := chain.outside_limits(q):
            first = outside[0]
            more = f" (and {len(outside) - 1} more commands)" if len(outside) > 1 else ""
            raise SessionError(
                f"{first}{more}",
                where=table.place(first.pose, first.joint.name),
                remedy="Commands are in radians and metres, of the robot that was calibrated.",
            )
        return cls(table, chain.actuated, q)

    def beside(self, path: Path, chain: Mechanism) -> Floats:
        """Read a number for each actuated joint (N, k), such as a torque, in a table with a row for each command.

        Raises:
            SessionError: the file cannot be read, a joint has no column, a number is none, or rows are missing.
        """
        values = Table.read(path, chain.actuated, ignored=None).numbers(chain.actuated)
        if len(values) != len(self.q):
            what = f"it has {len(values)} rows, the trajectory {len(self.q)}"
            raise SessionError(what, where=str(path), remedy="Give each pose of the trajectory its row.")
        return values

    def line(self, pose: int) -> int:
        """The line of the file, counted from 1, that holds a pose."""
        return pose + 2

    def with_commands(self, q: Floats) -> str:
        """The table with other commands (N, k) [rad or m]; columns, their order and all other cells as they were."""
        columns = dict(self.table.columns)
        for name, values in zip(self.joints, q.T.tolist(), strict=True):
            columns[name] = [repr(value) for value in values]
        return csv_text(columns, zip(*columns.values(), strict=True))


def csv_text(header: Iterable[str], rows: Iterable[Sequence[object]]) -> str:
    """A CSV file of its header and its rows."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
