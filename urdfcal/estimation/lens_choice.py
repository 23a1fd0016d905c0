"""Which of a session's cameras are judged with the lenses that a calibration found, and which with their own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from urdfcal.estimation.evaluation import explain
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.validation import loss

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from urdfcal.cameras.camera import Camera
    from urdfcal.estimation.joint_models.found import FoundJointModels
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session

# Lenses suit alike where the loss of a camera's residuals differs by less: a tenth of the noise.
_SUITS = 0.1


@dataclass(frozen=True)
class LensChoice:
    """The lenses that a session's detections speak for.

    Attributes:
        session: with these lenses.
        found: names of the cameras that have the ones found.
        told: names of those for which the detections tell the two lenses apart.
    """

    session: Session
    found: frozenset[str]
    told: frozenset[str]


def choose_lenses(
    session: Session, chain: Mechanism, found: Mapping[str, Camera], bends: FoundJointModels
) -> LensChoice:
    """Choose, camera by camera, between a session's lenses and those found with an arm.

    Args:
        session: what was measured; without detections, or where nothing was found, it keeps its lenses.
        chain: the calibrated arm.
        found: cameras with the lenses found, by name.
        bends: the arm's joint models.
    """
    if not found or session.find(Detections) is None:
        return LensChoice(session, frozenset(), frozenset())

    def with_lenses(names: Collection[str]) -> Session:
        cameras = tuple(found[one.name] if one.name in names else one for one in session.rig.cameras)
        return replace(session, rig=replace(session.rig, cameras=cameras))

    def loss_with(names: Collection[str]) -> float:
        explained = explain(chain, with_lenses(names), bends=bends)
        pairs = zip(explained.fit.norms, explained.problem.observations, strict=True)
        norms, observations = zip(*((n, of) for n, of in pairs if isinstance(of.table, Detections)), strict=True)
        return loss(norms, observations)

    margin = _SUITS / len(session.rig.cameras)
    chosen, least = frozenset[str](), loss_with(())
    if (other := loss_with(found)) < least - margin:
        chosen, least = frozenset(found), other
    told = chosen
    for name in found:  # each camera by itself: one may be another since
        changed = loss_with(chosen ^ {name})
        told = told | {name} if abs(changed - least) > margin else told - {name}
        if changed < least - margin:
            chosen, least = chosen ^ {name}, changed
    return LensChoice(with_lenses(chosen) if chosen else session, chosen, told)
