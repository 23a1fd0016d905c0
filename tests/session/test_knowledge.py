"""How well things were measured, for kinds that this release knows and for those that it does not."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.io.kinds import Contacts
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import MEASUREMENTS, Detections, Points
from urdfcal.session.knowledge import Noise

if TYPE_CHECKING:
    from urdfcal.session.measurements import Measurements


class TestNoise:
    def test_each_kind_has_its_own(self) -> None:
        noise = Noise(pixel=0.3, point=2e-5, joint=1e-4)
        assert noise.of(Detections) == 0.3
        assert noise.of(Points) == 2e-5

    def test_of_a_further_kind_it_is_the_usual_one_unless_named(self) -> None:
        assert Noise(pixel=0.3).of(Contacts) == 3e-4
        noise = Noise(pixel=0.3, other={"contact": 5e-5})
        assert noise.of(Contacts) == 5e-5
        assert noise.of(Detections) == 0.3
        assert noise.of(Points) == 1e-4

    @pytest.mark.parametrize("kind", MEASUREMENTS)
    def test_what_is_usual_is_said_once(self, kind: type[Measurements]) -> None:
        """The defaults of a session made in Python are those of one read from a file."""
        assert Noise().of(kind) == kind.usual

    def test_others_are_plain_numbers_that_cannot_be_written_to(self) -> None:
        given = {"contact": np.float32(0.5)}
        noise = Noise(other=given)
        given["contact"] = np.float32(1.0)
        assert noise.other == {"contact": 0.5}
        assert type(noise.other["contact"]) is float
        with pytest.raises(TypeError):
            noise.other["contact"] = 1.0  # type: ignore[index]

    @pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "0.1", True, None])
    def test_others_are_positive(self, value: Any) -> None:
        with pytest.raises(SessionError, match=r"noise.*contact is .*, not a positive number"):
            Noise(other={"contact": value})

    def test_it_compares_by_what_it_says_and_travels(self) -> None:
        noise = Noise(other={"contact": 0.5})
        assert noise == Noise(other={"contact": 0.5})
        assert noise != Noise()
        assert pickle.loads(pickle.dumps(noise)) == noise  # noqa: S301 - our own
