"""What is fastened to what, in words: for robots that branch, carry a camera, or watch LEDs that stand still."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.robot.tree_dh import MOUNT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.session.model import Session

MOUNTS = (
    f"A row that ends in {MOUNT} leads from an axis of the link that carries a further branch to that branch's "
    "first joint axis."
)


def fastening_sentences(session: Session) -> tuple[str, ...]:
    """Say what is fastened to what, and what the figures mean then.

    Nothing where every LED is on the tip link and every camera stands still: that goes without saying.
    """
    frames, chain = session.attachments, session.chain
    links = [tip.link for tip in frames.tips]
    riding = np.flatnonzero(frames.camera)
    if len(chain.tips) == 1 and np.all(frames.led == 1) and not len(riding):
        return ()
    parts = []
    for frame in sorted(set(frames.led.tolist())):
        names = [name for name, of in zip(session.led_names, frames.led, strict=True) if of == frame]
        where = f"on {links[frame - 1]}" if frame else "fixed in the world"
        parts.append(f"{listed(names)} {where}")
    sentences = [f"LEDs: {'; '.join(parts)}."]
    if session.rig.cameras:
        for c in riding:
            link = links[frames.camera[c] - 1]
            sentences.append(
                f"Camera {session.rig.cameras[c].name} rides on {link}: an error in mm is how far an LED is, across "
                "the camera's ray, from where the joints between the two put it."
            )
        if any(np.count_nonzero(frames.camera == frames.camera[c]) == 1 for c in riding):
            sentences.append("An LED that one camera alone sees is drawn on its ray, as far away as predicted.")
    if len(chain.tips) > 1:
        sentences.append(f"What is said of the tip and its workspace is about {chain.tip_link}.")
    return tuple(sentences)


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence: one, two and three."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
