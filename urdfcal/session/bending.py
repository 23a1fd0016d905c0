"""Sessions of arms whose links may bend: their joints with flexures in between."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from urdfcal.robot.flexure import rigid_joints, with_flexures

if TYPE_CHECKING:
    from typing import TypeVar

    from urdfcal.arrays import Floats
    from urdfcal.session.model import Positions

    Some = TypeVar("Some", bound=Positions)

BENDING = "bending"
"""The joint model's name, under which a session says of which links it is asked."""


def bent(session: Some, joints: tuple[str, ...] | None = None) -> Some:
    """Return a session with flexures in the links that are to bend, of all tables that go by joints; else the same.

    Args:
        session: what it says of bending under ``joint_models``.
        joints: names of those before which links bend, whatever it says.
    """
    if joints is None:
        said: Any = session.joint_models.get(BENDING, False)
        each = dict.fromkeys(session.chain.actuated, said) if isinstance(said, str | bool) else dict(said)
        joints = tuple(joint for joint, on in each.items() if on)
    if not joints or len(rigid_joints(session.chain)) < len(session.chain.joints):
        return session
    drawn, chain = session.chain, with_flexures(session.chain, joints)

    def spread(q: Floats) -> Floats:
        return chain.joint_values(drawn.readings(q))

    return replace(
        session,
        chain=chain,
        q=spread(session.q),
        torques=None if session.torques is None else chain.torques(drawn.readings(session.torques)),
        previous=None if session.previous is None else spread(session.previous),
        motion=session.motion.read_otherwise(spread),
    )
