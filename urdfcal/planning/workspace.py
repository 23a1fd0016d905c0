"""Where the tip is to be accurate: the joints' ranges, a box, a path, or the poses of a session."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from urdfcal.arrays import Floats, finite_array
from urdfcal.errors import SessionError
from urdfcal.robot.box import in_box, parse_box

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session

WorkspaceOfInterest: TypeAlias = "Literal['session'] | Path | tuple[Floats, Floats] | Floats | None"
"""None for the joints' ranges; "session"; a CSV file of joint values; corners of a box [m]; joint values (M, n)."""

# Configurations that stand for the workspace: the expected error is within 3 % of that over ten times as many.
_COUNT = 300
# A box that fewer than 1 in 1,000 configurations reach is out of reach, or mistyped.
_DRAWS = 100_000
_LEAST = 30


def workspace_values(
    workspace: WorkspaceOfInterest, chain: Mechanism, session: Session | None, seed: int = 0
) -> Floats:
    """Return joint values (M, n) that stand for a workspace.

    Raises:
        SessionError: the path cannot be read, the box is none or out of reach, or there is no session.
    """
    rng = np.random.default_rng(seed)
    if workspace is None:
        return chain.random_values(_COUNT, rng)
    if isinstance(workspace, str) and workspace == "session":
        if session is None:
            what, remedy = "nothing is measured yet", "Name a box or a path, or leave --workspace out."
            raise SessionError(what, where="workspace: session", remedy=remedy)
        return session.q
    if isinstance(workspace, (str, Path)):
        from urdfcal.io.csv_table import Table

        return chain.joint_values(Table.read(Path(workspace), chain.actuated, ignored=None).numbers(chain.actuated))
    if isinstance(workspace, tuple):
        low, high = (finite_array(corner, (3,), "corner", "workspace") for corner in workspace)
        return _in_box(chain, low, high, rng)
    return finite_array(workspace, (len(workspace), len(chain.joints)), "joint values", "workspace")


def parse_workspace(text: str | None) -> WorkspaceOfInterest:
    """Read a workspace from the command line: ``session``, a file of joint values, or a box.

    Raises:
        RobotError: it is none of these.
    """
    if text is None or text == "session":
        return text  # type: ignore[return-value]
    return Path(text) if Path(text).is_file() else tuple(parse_box(text).T)


def _in_box(chain: Mechanism, low: Floats, high: Floats, rng: np.random.Generator) -> Floats:
    where = f"workspace box {_said(low)} to {_said(high)} m"
    if not np.all(low < high):
        raise SessionError(
            "its least corner is not below its largest", where=where, remedy="Name the least x, y and z first."
        )
    q = chain.random_values(_DRAWS, rng)
    q = q[in_box(chain, q, np.stack([low, high], axis=1))][:_COUNT]
    if len(q) < _LEAST:
        what = f"of {_DRAWS} random poses {len(q)} bring {chain.tip_link} into it"
        raise SessionError(
            what, where=where, remedy="It is in the base link's frame, in m: make it larger, or move it."
        )
    return q


def _said(corner: Sequence[float] | Floats) -> str:
    return "(" + ", ".join(f"{value:g}" for value in corner) + ")"
