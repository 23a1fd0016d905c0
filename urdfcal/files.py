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
        OutputError: the folder is not there, cannot be written, or is full.
    """
    with _told(path):
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
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


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield an empty folder; when the block succeeds, move its files into ``folder``, which is made if need be.

    Raises:
        OutputError: ``folder`` is a file, or it or its parent cannot be written, or is full.
    """
    with _told(folder):
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "it is a file")
        beside = folder if folder.exists() else folder.absolute().parent
        stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=beside))
        try:
            yield stage
            folder.mkdir(exist_ok=True)
            for path in stage.iterdir():
                if (folder / path.name).is_dir():
                    raise IsADirectoryError(errno.EISDIR, f"{path.name} is a folder")
            for path in stage.iterdir():
                path.replace(folder / path.name)
        finally:
            shutil.rmtree(stage, ignore_errors=True)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Say where writing failed, and what to do."""
    try:
        yield
    except OSError as error:
        remedy = "Make room there." if error.errno == errno.ENOSPC else "Name a place that can be written."
        raise OutputError(f"cannot write here: {error.strerror or error}", where=str(path), remedy=remedy) from error


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` in one step: all of it or nothing."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` in one step: all of it or nothing."""
    write_bytes(path, text.encode("utf-8"))
