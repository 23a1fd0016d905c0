"""Files read once, so that what was hashed is what was used, and written so that a failed run leaves nothing behind."""

from __future__ import annotations

import errno
import hashlib
import json
import secrets
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from urdfcal.errors import OutputError, SessionError
from urdfcal.temporaries import alone_in, temporary

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping


# Names in a folder of what is being put there: files that are all written, and the list of those they replace.
_OURS, _WHOLE, _GONE = "urdfcal", ".whole", ".replaced.json"
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
        OutputError: the folder is not there, cannot be written, or is full, or ``path`` is a folder.
    """
    with told(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        with temporary(path.parent, path.name, lambda new: new.touch(exist_ok=False), path.suffix) as new:
            yield new
            new.replace(path)


@contextmanager
def staged(folder: Path, replaced: Iterable[str] = (), joined: str | None = None) -> Iterator[Path]:
    """Yield an empty folder; when the block succeeds, its files are those of ``folder``, which is made if need be.

    A process that is killed leaves the old files or, at the very end, the new ones, which :func:`settle` finishes
    putting there: never some of each. What killed ones left behind is cleaned up.

    Args:
        folder: where the files go.
        replaced: names of files that go when the new ones come, beside those of the same names.
        joined: name of a folder in it whose new files join those that are there.

    Raises:
        OutputError: ``folder`` is a file, or it or its parent cannot be written, or is full.
    """
    with told(folder):
        beside, stem = _stage_of(folder)
        settle(folder)
        with temporary(beside, stem, Path.mkdir) as stage:
            yield stage
            if beside != folder and not folder.exists():
                stage.rename(folder)
                return
            names = {path.name for path in stage.iterdir() if path.name != joined}
            if joined is not None and (stage / joined).is_dir():
                names |= {f"{joined}/{path.name}" for path in (stage / joined).iterdir()}
                if (folder / joined).exists() and not (folder / joined).is_dir():
                    raise NotADirectoryError(errno.ENOTDIR, f"{joined} is a file")
            gone = sorted({*names, *replaced})
            for name in gone:
                if (folder / name).is_dir():
                    raise IsADirectoryError(errno.EISDIR, f"{name} is a folder")
            (stage / _GONE).write_text(json.dumps(gone), encoding="utf-8")
            whole = folder / f".{_OURS}.{secrets.token_hex(4)}{_WHOLE}"
            with alone_in(folder):
                stage.rename(whole)
                _put(whole, folder, gone)


def check_place(folder: Path) -> None:
    """Refuse, before long work, a folder that :func:`staged` could not put its files in.

    Raises:
        OutputError: it is a file, or it or its parent cannot be written.
    """
    with told(folder), temporary(*_stage_of(folder), Path.mkdir):
        pass


def _stage_of(folder: Path) -> tuple[Path, str]:
    """Where files wait that go into a folder, and the stem of that place's name.

    Raises:
        OSError: it is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "it is a file")
    return (folder, _OURS) if folder.exists() else (folder.absolute().parent, folder.name)


def settle(folder: Path) -> None:
    """Finish putting files into a folder where a process was killed while it did, so that all of them are there.

    Args:
        folder: where :func:`staged` puts files; or none.

    Raises:
        OutputError: the folder cannot be written, or what is to be put there is nothing that :func:`staged` left.
    """
    if not any(folder.glob(f".{_OURS}.*{_WHOLE}")):
        return
    with told(folder), alone_in(folder):
        for whole in sorted(folder.glob(f".{_OURS}.*{_WHOLE}")):
            _put(whole, folder, _listed(whole, folder))


def _listed(whole: Path, folder: Path) -> list[str]:
    """Read which files are to go, and refuse what would reach out of the folder: it may be someone else's making.

    Raises:
        OutputError: one is not in the folder, or in one of its folders whose files are joined; or links lead elsewhere.
    """
    into = [path.name for path in whole.iterdir() if path.is_dir()]
    what = next((f"{path} is a link" for path in (whole, *whole.iterdir()) if path.is_symlink()), "")
    what = what or next((f"{path} is a link" for path in map(folder.joinpath, into) if path.is_symlink()), "")
    names = []
    if not what and (whole / _GONE).exists():
        try:
            names = json.loads((whole / _GONE).read_text(encoding="utf-8"))
        except (ValueError, RecursionError):
            what = f"{_GONE} is not JSON"
        if not isinstance(names, list):
            what = f"{_GONE} is no list"
        elif odd := [name for name in names if not _is_inside(name, into)]:
            what = f"{_GONE} has {odd[0]!r}, which is no file's name there"
    if what:
        remedy = f"Remove {whole.name} if nothing in it is of use, and make the results anew."
        raise OutputError(f"these are not files that urdfcal was putting here: {what}", where=str(whole), remedy=remedy)
    return names


def _is_inside(name: object, into: Collection[str]) -> bool:
    """Whether this names a file of a folder, or of one of some folders in it."""
    if not isinstance(name, str) or not name.isprintable():
        return False
    parts = Path(name).parts
    return ".." not in parts and not Path(name).anchor and (len(parts) == 1 or (len(parts) == 2 and parts[0] in into))


def _put(whole: Path, folder: Path, gone: Iterable[str]) -> None:
    """Take old files away, then put the new ones there; begun again after a kill, it goes on where it was.

    Between the two some files are missing, which any program that reads them notices, other than a mixture.
    """
    for name in gone:
        (folder / name).unlink(missing_ok=True)
    (whole / _GONE).unlink(missing_ok=True)
    for path in list(whole.iterdir()):
        new = folder / path.name
        if path.is_dir() and new.is_dir():
            for file in list(path.iterdir()):
                file.replace(new / file.name)
            path.rmdir()
        else:
            path.replace(new)
    whole.rmdir()


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


@contextmanager
def written(texts: Mapping[Path, str]) -> Iterator[None]:
    """Write texts as UTF-8, each to its path, when the block succeeds as well: all of them or nothing.

    Raises:
        OutputError: one of them cannot be written.
    """
    with ExitStack() as stack:
        for path, text in texts.items():
            stack.enter_context(replacing(path)).write_bytes(text.encode())
        yield


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` in one step: all of it or nothing."""
    write_bytes(path, text.encode("utf-8"))
