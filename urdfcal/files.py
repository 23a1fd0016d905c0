"""Writing files so that a failed run leaves nothing behind."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from urdfcal.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it over ``path`` when the block succeeds.

    Raises:
        OutputError: the folder is not there or cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise OutputError(
            f"cannot write here: {error.strerror}",
            where=str(path),
            remedy="Name a folder that can be written.",
        ) from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes files only the owner can read; a result is shared like any other file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` in one step: all of it or nothing."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` in one step: all of it or nothing."""
    write_bytes(path, text.encode("utf-8"))


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield an empty folder; when the block succeeds, move its files into ``folder``, which is made if need be.

    Raises:
        OutputError: ``folder`` is a file, or it or its parent cannot be written.
    """
    parent = folder.absolute().parent
    try:
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "it is a file")
        stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder if folder.exists() else parent))
    except OSError as error:
        raise OutputError(
            f"cannot write here: {error.strerror}", where=str(folder), remedy="Name a folder that can be written."
        ) from error
    try:
        yield stage
        folder.mkdir(exist_ok=True)
        for path in stage.iterdir():
            path.replace(folder / path.name)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
