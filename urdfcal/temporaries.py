"""Temporary files and folders that another process removes if theirs was killed, and never while it lives."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

try:
    import fcntl
except ImportError:  # Windows: there nothing tells what is left over from what is being written, and it is kept
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

_PARTIAL = ".partial"


@contextmanager
def temporary(beside: Path, stem: str, make: Callable[[Path], object], suffix: str = _PARTIAL) -> Iterator[Path]:
    """Yield a new hidden path, whose like that killed processes left behind goes; it is removed in the end.

    Args:
        beside: the folder it is in.
        stem: its name is ``.<stem>.<random><suffix>``.
        make: makes the file or folder.
        suffix: of the name.

    Raises:
        OSError: it cannot be made.
    """
    for path in _alike(beside, stem, suffix):
        with suppress(OSError), _locked(path):
            _remove(path)
    while True:
        path = beside / f".{stem}.{secrets.token_hex(4)}{suffix}"
        make(path)
        with _locked(path, wait=True):
            if not path.exists():  # another process took it for left over before it was locked
                continue
            try:
                yield path
            finally:
                _remove(path)
            return


def _alike(beside: Path, stem: str, suffix: str) -> list[Path]:
    name = re.compile(rf"\.{re.escape(stem)}\.[0-9a-f]{{8}}{re.escape(suffix)}")
    with suppress(OSError):
        return [path for path in beside.iterdir() if name.fullmatch(path.name)]
    return []


@contextmanager
def _locked(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a lock that the system takes from a process however it ends.

    Raises:
        OSError: without ``wait``: another process has it, or there are no locks here.
    """
    if fcntl is None:
        if not wait:
            raise BlockingIOError
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        if wait:
            with suppress(OSError):  # a file system without locks: nothing is ever taken for left over
                fcntl.flock(handle, fcntl.LOCK_EX)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process is in this block for the same folder, which is there.

    Raises:
        OSError: the folder cannot be read.
    """
    with _locked(folder, wait=True):
        yield


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
