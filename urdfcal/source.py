"""One input file: read once, so that what was hashed is what was used."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from pathlib import Path

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
            raise SessionError(
                f"{found} is not UTF-8 text", where=f"{self.path}:{line}", remedy="Save the file as UTF-8."
            ) from error
        return text.replace("\r\n", "\n").replace("\r", "\n")
