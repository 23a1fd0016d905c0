"""The rigs that come with urdfcal, and where to find any other."""

from pathlib import Path

from urdfcal.errors import SessionError

_FILE = "rig.yaml"


def shipped_rigs() -> dict[str, Path]:
    """Name the rigs that come with urdfcal, and the folder of each, in alphabetical order."""
    package = Path(__file__).resolve().parent.parent
    # In a wheel the rigs lie inside the package, in the source tree beside it.
    places = (package / "rigs", package.parent / "robots")
    home = next((place for place in places if place.is_dir()), None)
    return {file.parent.name: file.parent for file in sorted(home.glob(f"*/{_FILE}"))} if home else {}


def find_rig(name_or_path: str | Path) -> Path:
    """Find a rig's folder.

    Args:
        name_or_path: a shipped rig's name, a folder that holds a rig.yaml, or that file. A name wins over a
            folder of the same name: write ``./ur5`` for the folder.

    Raises:
        SessionError: there is no such rig.
    """
    shipped, path = shipped_rigs(), Path(name_or_path)
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    if path.is_file() and path.name == _FILE:
        return path.parent
    if (path / _FILE).is_file():
        return path
    what = f"this folder has no {_FILE}" if path.is_dir() else "there is no such rig"
    remedy = f"Shipped rigs are: {', '.join(shipped)}. Or name a folder with a {_FILE}."
    raise SessionError(what, where=str(name_or_path), remedy=remedy)
