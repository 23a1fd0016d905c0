"""Files read once, so that what was hashed is what was used, and written so that a failed run leaves nothing behind."""

from __future__ import annotations

import errno
import hashlib
import secrets
import shutil
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from urdfcal.errors import OutputError, SessionError

if TYPE_CHECKING:
    from collections.abc import Iterator


_UTF16 = (b"\xff\xfe", b"\xfe\xff")


@dataclass(frozen=True)
class Source:
    """The content of one file.

    Attributes:
        path: as the user would name it.
        data: its bytes.
    """

    path: Path
    data: bytes

    @classmethod
    def read(cls, path: Path) -> Source:
        """Read ``path``.

        Raises:
            SessionError: it cannot be read.
        """
        try:
            return cls(path, path.read_bytes())
        except OSError as error:
            raise SessionError(f"cannot be read: {error.strerror}", where=str(path)) from error

    @property
    def sha256(self) -> str:
        """Hash of the bytes, in hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()

    @property
    def text(self) -> str:
        """The content as text, every line end a line feed, without a byte order mark.

        Raises:
            SessionError: it is not UTF-8.
        """
        try:
            text = self.data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = self.data.count(b"\n", 0, error.start) + 1
            found = "UTF-16" if self.data.startswith(_UTF16) else f"byte 0x{self.data[error.start]:02x}"
            where = f"{self.path}:{line}"
            raise SessionError(f"{found} is not UTF-8 text", where=where, remedy="Save the file as UTF-8.") from error
        return text.replace("\r\n", "\n").replace("\r", "\n")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it over ``path`` when the block succeeds.

    Raises:
        OutputError: the folder is not there, cannot be written, or is full.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}{path.suffix}")
    with told(path):
        temporary.touch(exist_ok=False)
        try:
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield an empty folder; when the block succeeds, move its files into ``folder``, which is made if need be.

    Raises:
        OutputError: ``folder`` is a file, or it or its parent cannot be written, or is full.
    """
    with told(folder):
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
def told(path: Path, remedy: str = "Name a place that can be written.") -> Iterator[None]:
    """Say where writing failed, and what to do.

    Raises:
        OutputError: instead of any error of the operating system.
    """
    try:
        yield
    except OSError as error:
        remedy = "Make room there." if error.errno == errno.ENOSPC else remedy
        raise OutputError(f"cannot write here: {error.strerror or error}", where=str(path), remedy=remedy) from error


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` in one step: all of it or nothing."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` in one step: all of it or nothing."""
    write_bytes(path, text.encode("utf-8"))
