"""Shipped rigs before cameras of half the resolution: pictures take a quarter of the time."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import yaml

from urdfcal.io.shipped_rigs import find_rig

if TYPE_CHECKING:
    from pathlib import Path


def halved(rig: str, folder: Path) -> Path:
    """Copy a shipped rig to a folder that is not there yet, with its cameras' sides halved."""
    shutil.copytree(find_rig(rig), folder)
    cameras = yaml.safe_load((folder / "cameras.yaml").read_text())
    for camera in cameras.values():
        camera["resolution"] = [side // 2 for side in camera["resolution"]]
        camera["intrinsics"] = [value / 2.0 for value in camera["intrinsics"]]
    (folder / "cameras.yaml").write_text(yaml.safe_dump(cameras))
    return folder
