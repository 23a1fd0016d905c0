"""What kills its worker: alone here, for a worker imports this file, and again each time that one has died."""

from __future__ import annotations

import os
import signal


def dying(task: tuple[int, str]) -> int:
    """The first time it is called with 3, the system kills its process."""
    number, mark = task
    if number == 3 and not os.path.exists(mark):  # noqa: PTH110
        open(mark, "w").close()  # noqa: PTH123
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def mortal(task: int) -> int:
    if task == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return task
