"""Images of a calibration board as a camera would take them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.simulation.prints import PlacedPrint, PrintRenderer, board_print

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.arrays import Floats
    from urdfcal.cameras.board.board import Board


class BoardRenderer(PrintRenderer):
    """Renders boards through one camera's lens, in 8 bits."""

    def render(
        self,
        board: Board,
        T_cam_board: Floats,
        *,
        blur: float = 0.8,
        noise: float = 0.0,
        smear: tuple[float, float] = (0.0, 0.0),
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.uint8]:
        """Take an image.

        Args:
            board: what is seen, printed with a white margin one square wide.
            T_cam_board: where it is, (4, 4).
            blur: standard deviation of the point spread, px.
            noise: standard deviation of a pixel, grey levels.
            smear: way of the image during the exposure, px.
            rng: draws the noise; needed if there is any.

        Returns:
            (height, width) grey levels.
        """
        image = self.expected([PlacedPrint(T_cam_board, board_print(board))], blur, smear)
        if noise > 0.0:
            if rng is None:
                raise ValueError("noise needs a random generator")
            image += noise * rng.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)
