"""Denavit-Hartenberg rows of a chain or a tree, and joint placements from row offsets (METHOD 2 to 4).

Standard (distal) rows extended by Hayati's beta for parallel axes,

    B(theta, d, a, alpha, beta) = Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta),

so that F_i = F_{i-1} Rz(q_i) B_i for a revolute joint i and F_{i-1} Tz(q_i) B_i for a prismatic one.
Sources: Rossi, Savino et al., eq. 2; Hayati & Mirmirani, J. Robotic Systems 2(4), 1985; Craig,
"Introduction to Robotics", ch. 3, for the modified rows.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen, inverse
from urdfcal.errors import RobotError
from urdfcal.robot.mechanism import BASE
from urdfcal.rotations import skew

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike
    from typing_extensions import Self

    from urdfcal.robot.mechanism import JointType, Mechanism

Parameter = Literal["theta", "d", "a", "alpha", "beta"]
Convention = Literal["standard", "modified"]

PARAMETERS: tuple[Parameter, ...] = ("theta", "d", "a", "alpha", "beta")
"""Column order of every offsets array."""

MOUNT = ".mount"
"""Suffix of a mount's label, after the name of the branch's first joint."""

_COLUMN: dict[str, int] = {name: column for column, name in enumerate(PARAMETERS)}
# The twist (linear, angular) that each factor of B moves along.
_MOTIONS: dict[str, Floats] = dict(zip(PARAMETERS, frozen(np.eye(6)[[5, 2, 0, 3, 4]]), strict=True))
_IDENTITY = frozen(np.eye(4))


@dataclass(frozen=True, eq=False)
class DHRow:
    """One row of a DH table, from a joint's axis to the next joint's; the last one leads to the tip's z axis.

    A mount leads from an axis of a link's frame to the first joint's axis of a branch that hangs on that link.

    Attributes:
        joint: the joint that moves this row's frame; of a mount the one that it leads to.
        type: of the joint: revolute, continuous or prismatic.
        values: in the order of ``PARAMETERS`` theta, the rotation about z at zero joint value, d, the shift along z, a,
            that along x, the common normal, alpha, the rotation about x, and beta, that about y, non-zero only where
            this axis and the next are almost parallel. [rad, m]
        parallel: whether the next axis is within ``PARALLEL_ANGLE`` of (anti-)parallel.
        directed: whether the next axis is a prismatic joint's, which has a direction but no position.
        last: whether there is no next joint.
        mount: whether it is a mount, which no joint moves.
    """

    joint: str
    type: JointType
    values: tuple[float, ...]
    parallel: bool
    directed: bool
    last: bool = False
    mount: bool = False

    @property
    def variable(self) -> Parameter | None:
        """The parameter that the joint's value is added to; its offset is the joint's zero offset."""
        if self.mount:
            return None
        return "d" if self.type == "prismatic" else "theta"

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters that the neighbouring rows' cannot replace (METHOD 3)."""
        directions = ("alpha", "beta") if self.parallel else ("theta", "alpha")
        lines = ("theta", "a", "alpha", "beta") if self.parallel else ("theta", "d", "a", "alpha")
        return tuple(p for p in PARAMETERS if p in (directions if self.directed else lines) or p == self.variable)


@dataclass(frozen=True, eq=False)
class DHTable:
    """The DH rows of a chain: FK(q) = base * prod((Rz(q_i) or Tz(q_i)) B_i) * tool.

    Of a tree it has the rows of one serial branch after the other, each but the first with its mount before them.

    Attributes:
        columns: the names of an offsets array's columns.
        chain: the joints that the rows describe.
        base: (4, 4) T_base_F0: F0 has z on the first axis and its origin at the foot of the base link's origin.
        rows: one per joint, and the mounts.
        tool: (4, 4) T_FR_tip: a rotation about and a shift along z.
        K: (R, 4, 4) constant K_i = F_{i-1}^-1 L_i at zero joint values, L_i being joint i's URDF frame; of a mount the
            carrying link's frame in one whose z axis it leads from.
        ends: (R, 4, 4) from each row's end to the next DH frame: none but a mount has its end elsewhere on the axis.
    """

    columns: ClassVar[tuple[str, ...]] = PARAMETERS
    chain: Mechanism
    base: Floats
    rows: tuple[DHRow, ...]
    tool: Floats
    K: Floats
    ends: Floats

    @classmethod
    def from_chain(cls, chain: Mechanism) -> Self:
        """Derive the rows from the axis lines at zero joint values (METHOD 2)."""
        from urdfcal.robot.tree_dh import derive

        return cls(chain, *derive(chain))

    @property
    def parameters(self) -> tuple[tuple[int, Parameter], ...]:
        """(row, name) of every parameter that moves a joint and that no other parameter can replace."""
        return tuple((i, p) for i, row in enumerate(self.rows) for p in row.free if not row.last or p == row.variable)

    @property
    def zeros(self) -> tuple[tuple[int, Parameter], ...]:
        """(row, name) of every joint's zero offset."""
        return tuple((i, row.variable) for i, row in enumerate(self.rows) if row.variable)

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of an offsets array's rows: the joints', and those of mounts."""
        return tuple(row.joint + MOUNT * row.mount for row in self.rows)

    @property
    def following(self) -> tuple[int | None, ...]:
        """Of joints that branch, the number from 1 of the row that each row follows, None at the base; else nothing."""
        if not any(row.mount for row in self.rows):
            return ()
        numbers = {(row.joint, row.mount): k for k, row in enumerate(self.rows, 1)}
        above = dict(zip(self.chain.names, self.chain.parents, strict=True))
        found = []
        for row in self.rows:
            before = above[row.joint]
            carrier = None if before == BASE else numbers[self.chain.names[before], False]
            found.append(carrier if row.mount else numbers.get((row.joint, True), carrier))
        return tuple(found)

    def reason(self, row: int, name: str) -> str:
        """Say why a parameter of a row is never estimated."""
        shape = self.rows[row]
        if shape.mount:
            return "a mount is a line in space: four numbers, or two for the direction of a sliding joint's"
        if shape.last:
            return "it places the tip on the last link, which is no joint's origin"
        if shape.directed and (name in ("d", "a") or (name == "theta") == shape.parallel):
            return "the next joint slides: its axis has a direction but no position"
        if shape.parallel and name == "d":
            return "the next axis is parallel: d of the two rows only appears as a sum"
        return "the next axis is not parallel: the common normal needs no beta"

    @property
    def nominal(self) -> Floats:
        """The nominal rows (R, 5), columns as ``PARAMETERS``. [rad, m]."""
        return np.array([row.values for row in self.rows])

    def frames(self, q: ArrayLike, offsets: ArrayLike | None = None) -> Floats:
        """Compute every DH frame of a chain in the base link's frame.

        Args:
            q: (n,) joint values. [rad or m]
            offsets: (n, 5) added to the rows; none by default.

        Returns:
            (n + 1, 4, 4) T_base_F for F_0 ... F_n.
        """
        values = self.nominal if offsets is None else self.nominal + np.asarray(offsets)
        frames = [np.array(self.base)]
        for row, row_values, q_i in zip(self.rows, values, np.asarray(q, dtype=float), strict=True):
            frames.append(frames[-1] @ _factor(row.variable or "theta", q_i) @ row_transform(row_values))
        return np.array(frames)

    def forward(self, q: ArrayLike, offsets: ArrayLike | None = None) -> Floats:
        """Compute T_base_tip (4, 4) as the product of the rows: for checks and display; estimates use Pinocchio."""
        result: Floats = self.frames(q, offsets)[-1] @ self.tool
        return result

    def placements(self, offsets: ArrayLike) -> Floats:
        """Turn row offsets into joint placements (METHOD 4).

        A joint's zero offset moves the joint's own frame, the other parameters of its row place the next
        joint. The last row's other parameters would move the tip on its link, which no joint can: they must be zero.

        Args:
            offsets: (R, 5) added to the rows. [rad, m]

        Returns:
            (n, 4, 4) what replaces ``chain.placements``; rows without offsets leave theirs bit for bit.

        Raises:
            RobotError: an offset after the last joint of a branch.
        """
        own, shape = self._split(offsets)
        for row, offset in zip(self.rows, shape, strict=True):
            if row.last and np.any(offset):
                raise RobotError(
                    "the last row can only be offset in its joint variable",
                    where=f"joint {row.joint!r}",
                    remedy="Where the tip sits on the last link is not a joint's placement.",
                )
        left = np.roll(inverse(self.K) @ row_transform(self.nominal + shape) @ self.ends, 1, axis=0)
        left[0] = self.chain.placements[0] @ inverse(self.K[0])
        moved = np.any(own, axis=1)
        moved[1:] |= np.any(shape[:-1], axis=1)
        moved &= [not row.mount for row in self.rows]
        result = np.array(self.chain.placements)
        result[self._joints[moved]] = (left @ row_transform(own) @ self.K)[moved]
        return result

    def twists(self, offsets: ArrayLike, parameters: Iterable[tuple[int, str]]) -> Floats:
        """Compute the body twists of the joints' placements for each DH parameter: M_j <- M_j exp6(xi_j).

        Each parameter is one factor of one placement: with Q the transform to its right, xi = Ad(Q^-1) e.

        Args:
            offsets: (R, 5) where the derivative is taken.
            parameters: (row index, name) of each column.

        Returns:
            G (6 n, p), rows as the columns of Pinocchio's joint kinematic regressor.
        """
        parameters = list(parameters)
        if not parameters:  # of the nominal arm, which trials are of
            return np.zeros((6 * len(self.chain.joints), 0))
        own, shape = self._split(offsets)
        # To the right of a row's factors are the next joint's zero offset and K; the last row's Q is not used.
        Q = self.ends @ np.roll(row_transform(own) @ self.K, -1, axis=0)
        xi = parameter_twists(self.nominal + shape, Q)  # of each row's parameters, in the placement that holds them
        motions = np.array([_MOTIONS[name] for _, name in self.zeros])
        xi[self._own] = _through(motions, self.K[[i for i, _ in self.zeros]])
        G = np.zeros((len(self.chain.joints), 6, len(parameters)))
        for column, (i, name) in enumerate(parameters):
            held = i if name == self.rows[i].variable else i + 1
            G[self._joints[held], :, column] = xi[i, _COLUMN[name]]
        return G.reshape(6 * len(G), len(parameters))

    def start_frames(self, frames: Floats) -> Floats:
        """Compute the frames (N, R, 4, 4) that the rows start from, once their joints have moved them.

        Args:
            frames: (N, n + 1, 4, 4) frames of the base link and of every joint. [m]
        """
        parents = np.array(self.chain.parents)
        carriers = np.where([row.mount for row in self.rows], parents[self._joints], self._joints)
        result: Floats = frames[:, carriers + 1] @ inverse(self.K)
        return result

    def shape(self, offsets: Floats) -> Floats:
        """Compute the rows (R, 5) with offsets (R, 5), without those of joint variables. [rad, m]."""
        return self.nominal + self._split(offsets)[1]

    def _split(self, offsets: ArrayLike) -> tuple[Floats, Floats]:
        """Offsets (R, 5) of the joint variables alone, and of all other parameters, the rows' shape."""
        offsets = np.asarray(offsets, dtype=float)
        return np.where(self._own, offsets, 0.0), np.where(self._own, 0.0, offsets)

    @cached_property
    def _own(self) -> Bools:
        """Which parameter of each row, (R, 5), is its joint's variable."""
        return np.array([[name == row.variable for name in PARAMETERS] for row in self.rows])

    @cached_property
    def _joints(self) -> Ints:
        """The index of each row's joint, (R,)."""
        return np.array([self.chain.names.index(row.joint) for row in self.rows])

    def to_dict(self, convention: Convention = "standard", offsets: Floats | None = None) -> dict[str, Any]:
        """Return the table as plain data: rows, and how they compose to the forward kinematics.

        In the modified convention (Craig) the same five numbers are grouped the other way round: row i holds
        the a, alpha and beta that lead to axis i, and its own theta and d. The last frame sits where its x
        axis meets the last axis (Craig, section 3.4), so that the way to the tip is all in the tool.

        Args:
            convention: how the numbers are grouped.
            offsets: (n, 5) added to the rows, as a calibration finds them. [rad, m]
        """
        rows, base, tool = self.nominal if offsets is None else self.nominal + offsets, self.base, self.tool
        factors = "Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)"
        if convention == "modified":
            factors = "Tx(a) Rx(alpha) Ry(beta) Rz(theta) Tz(d)"
            tool = row_transform(rows[-1]) @ tool
            rows = np.hstack([rows[:, :2], np.roll(rows[:, 2:], 1, axis=0)])
            rows[0, 2:] = rows[-1, :2] = 0.0
        return {
            "convention": convention,
            "composition": f"FK = base * prod({factors}) * tool; q is added to theta, for a prismatic joint to d",
            "base_link": self.chain.base_link,
            "tip_link": self.chain.tip_link,
            "base": base.tolist(),
            "tool": tool.tolist(),
            "rows": [
                {
                    "joint": row.joint,
                    "type": row.type,
                    **{name: float(value) + 0.0 for name, value in zip(PARAMETERS, values, strict=True)},
                    **({"mimic": asdict(joint.mimic)} if joint.mimic else {}),
                }
                for row, joint, values in zip(self.rows, self.chain.joints, rows, strict=True)
            ],
        }


def row_transform(values: ArrayLike) -> Floats:
    """Compute B = Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta) of rows in this order: (..., 5) to (..., 4, 4)."""
    values = np.asarray(values, dtype=float)
    turns, d, a = values[..., [0, 3, 4]], values[..., 1], values[..., 2]
    (c, c_a, c_b), (s, s_a, s_b) = (np.moveaxis(of(turns), -1, 0) for of in (np.cos, np.sin))
    T = np.zeros((*values.shape[:-1], 4, 4))
    # Rx(alpha) Ry(beta), which Rz(theta) turns: its third row stays.
    x, y = (c_b, np.zeros_like(c), s_b), (s_a * s_b, c_a, -s_a * c_b)
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2], T[..., 2, 3] = -c_a * s_b, s_a, c_a * c_b, d
    for column in range(3):
        T[..., 0, column] = c * x[column] - s * y[column]
        T[..., 1, column] = s * x[column] + c * y[column]
    T[..., 0, 3], T[..., 1, 3], T[..., 3, 3] = a * c, a * s, 1.0
    return T


def parameter_twists(values: Floats, Q: Floats) -> Floats:
    """Compute the body twists (linear, angular) of B(values) Q: (..., 5) and (..., 4, 4) to (..., 5, 6).

    Each parameter is one factor; with Q' the transform to its right, xi = Ad(Q'^-1) e.
    """
    xi = np.empty((*values.shape, 6))
    for factor in reversed(PARAMETERS):
        xi[..., _COLUMN[factor], :] = _through(_MOTIONS[factor], Q)
        Q = _factor(factor, values[..., _COLUMN[factor]]) @ Q
    return xi


def _factor(name: Parameter, value: Floats | float) -> Floats:
    """One factor of B, (..., 4, 4) of values (...)."""
    value = np.asarray(value, dtype=float)
    T: Floats = np.empty((*value.shape, 4, 4))
    T[:] = _IDENTITY
    axis = {"theta": 2, "d": 2, "a": 0, "alpha": 0, "beta": 1}[name]
    if name in ("d", "a"):
        T[..., axis, 3] = value
        return T
    i, j = (axis + 1) % 3, (axis + 2) % 3
    T[..., i, i] = T[..., j, j] = np.cos(value)
    T[..., j, i] = np.sin(value)
    T[..., i, j] = -T[..., j, i]
    return T


def _through(motion: Floats, Q: Floats) -> Floats:
    """Transform twists (linear, angular) by Ad(Q^-1), both batched."""
    v, w = motion[..., :3], motion[..., 3:]
    R_T = np.swapaxes(Q[..., :3, :3], -1, -2)
    p = Q[..., :3, 3]
    moved = np.stack([v - (skew(p) @ w[..., None])[..., 0], np.broadcast_to(w, p.shape)], axis=-1)
    result: Floats = np.swapaxes(R_T @ moved, -1, -2).reshape(*Q.shape[:-2], 6)
    return result
