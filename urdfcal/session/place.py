"""How a camera or a target is fastened to a link, and how well that is known."""

from __future__ import annotations

import numpy as np

from urdfcal.arrays import frozen, keep
from urdfcal.errors import SessionError


def check_place(declared: object, name: str, where: str, *, exact: bool) -> None:
    """Check the transform and the standard deviations of a frozen dataclass, and make them read-only.

    Args:
        declared: with a field of this name, (4, 4) or None, and a field ``sigma``, (6,) or None. [m, rad]
        name: of the transform's field.
        where: what it is, for messages.
        exact: whether a standard deviation may be 0.

    Raises:
        SessionError: the transform is not rigid, a standard deviation is negative, or is given without a place.
    """
    place, spread = getattr(declared, name), getattr(declared, "sigma")  # noqa: B009
    if place is not None:
        T = frozen(place)
        R = T[:3, :3] if T.shape == (4, 4) else np.zeros((3, 3))
        if not np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-9) or np.linalg.det(R) < 0.0:
            raise SessionError(f"{name} is no rigid 4 x 4 transform", where=where)
        keep(declared, **{name: T})
    if spread is None:
        return
    sigma = frozen(spread)
    if place is None:
        raise SessionError("sigma is given without a place", where=where)
    if sigma.shape != (6,) or not np.all(np.isfinite(sigma) & ((sigma >= 0.0) if exact else (sigma > 0.0))):
        kind = "non-negative" if exact else "positive"
        raise SessionError(f"sigma is {sigma.tolist()}, not six {kind} numbers", where=where)
    keep(declared, sigma=sigma)
