from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from tests.io.making import write_points, write_valid
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError, OutputError, SessionError
from urdfcal.estimation.measurements import MEASUREMENTS, Detections, Points
from urdfcal.io.folder import read_session
from urdfcal.io.schema import SessionFile
from urdfcal.io.writing import write_session
from urdfcal.session.knowledge import Estimate, Led, LedDistance, Noise, Payload, Tolerances
from urdfcal.session.obstacle import Obstacle
from urdfcal.session.pattern import FramePattern
from urdfcal.session.target import Target

if TYPE_CHECKING:
    from urdfcal.session.model import Session

# Where it was read from is not what was read.
PROVENANCE = {"folder", "sha256", "path"}


def differences(a: Any, b: Any, name: str = "session") -> list[str]:
    """Fields in which two values differ, to the last bit."""
    if type(a) is not type(b):
        return [name]
    if is_dataclass(a):
        inner = [f.name for f in fields(a) if f.name not in PROVENANCE and not f.name.startswith("_")]
        return [d for key in inner for d in differences(getattr(a, key), getattr(b, key), f"{name}.{key}")]
    if isinstance(a, np.ndarray):
        same = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return [] if same else [name]
    if isinstance(a, tuple):
        pairs = enumerate(zip(a, b, strict=False))
        return [name] * (len(a) != len(b)) + [d for i, (x, y) in pairs for d in differences(x, y, f"{name}[{i}]")]
    return [] if a == b or name.endswith(".joints") else [name]


def varied(session: Session, rng: np.random.Generator) -> Session:
    """The same session, with all that may be said about it said at random."""
    count = len(session.poses)
    names = rng.permutation(["a,b", 'say "so"', "Ünïcode", "1", "on", "1e-3", "-", "{x: y}", "#7", "a: b", "'", "~"])
    leds = (
        Led(names[8], rng.normal(0.0, 0.1, 3), float(rng.choice([0.0, 1e-5, 0.02]))),
        Led(names[9], rng.normal(0.0, 0.1, 3)) if rng.random() < 0.5 else Led(names[9]),
    )
    changes: dict[str, Any] = {
        "poses": tuple(str(name) for name in [*names[:8], *range(100, 200)][:count]),
        "q": session.chain.joint_values(session.readings * rng.uniform(0.9, 1.0, (count, 4))),
        "leds": leds,
        "time": rng.uniform(0, 1e9, count) if rng.random() < 0.5 else None,
        "noise": Noise(*rng.uniform(1e-6, 1e-2, 3)),
        "estimate": [Estimate(), Estimate("full", "free"), Estimate("none"), Estimate(extrinsics="refine")][
            int(rng.integers(4))
        ],
        "tolerances": Tolerances(*rng.uniform(0, 1, 3), joints={"waist": {"a": rng.uniform(), "d": 0.0}, "roll": {}}),
    }
    tables = []
    for table in session.measurements:
        rows = table.rows(np.sort(rng.choice(len(table), len(table) * 3 // 4, replace=False)))
        own = rng.uniform(0.01, 0.2, len(rows)) if rng.random() < 0.5 else changes["noise"].of(type(table))
        tables.append(replace(rows, sigma=own))
    return replace(session, **changes, measurements=tuple(tables))


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return read_session(write_valid(tmp_path / "valid"))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("write_other", [write_valid, write_points], ids=["cameras", "tracker"])
def test_what_is_read_back_is_what_was_written(tmp_path: Path, write_other: Any, seed: int) -> None:
    written = varied(read_session(write_other(tmp_path / "valid")), np.random.default_rng(seed))
    write_session(tmp_path / "out", written)
    read = read_session(tmp_path / "out")
    assert differences(written, replace(read, warnings=written.warnings)) == []
    assert {name: dict(of) for name, of in read.tolerances.joints.items()} == {
        name: dict(of) for name, of in written.tolerances.joints.items()
    }


def test_the_comparison_sees_the_last_bit(session: Session) -> None:
    assert differences(session, session) == []
    assert session.find(Detections) is not None
    uv = session.find(Detections).uv.copy()
    uv[3, 1] = np.nextafter(uv[3, 1], 0.0)
    nudged = replace(
        session, measurements=(replace(session.find(Detections), uv=uv),), noise=Noise(pixel=0.1, joint=1e-9)
    )
    assert differences(session, nudged) == ["session.noise.joint", "session.measurements[0].uv"]


def test_pixels_and_points_together(tmp_path: Path, session: Session) -> None:
    points = read_session(write_points(tmp_path / "points")).find(Points)
    write_session(tmp_path / "out", replace(session, measurements=(*session.measurements, points)))
    assert (
        differences(replace(session, measurements=(*session.measurements, points)), read_session(tmp_path / "out"))
        == []
    )


@pytest.mark.parametrize(
    "models",
    [{}, {"zero_offset": True}, {"time_offset": False, "zero_offset": True}, {"gain": {"waist": True}, "lag": False}],
)
def test_joint_models_are_written_where_something_is_said_of_them(
    tmp_path: Path, session: Session, models: dict[str, Any]
) -> None:
    write_session(tmp_path / "out", replace(session, joint_models=models))
    assert ("joint_models" in (tmp_path / "out" / "session.yaml").read_text()) == bool(models)
    assert read_session(tmp_path / "out").joint_models == models


def test_cameras_of_unknown_place(tmp_path: Path, session: Session) -> None:
    assert session.rig is not None
    rig = Rig(session.rig.cameras, (np.eye(4), None))
    write_session(tmp_path / "out", replace(session, rig=rig))
    assert differences(replace(session, rig=rig), read_session(tmp_path / "out")) == []


def test_the_robot_goes_along_and_a_package_stays(tmp_path: Path, session: Session) -> None:
    write_session(tmp_path / "a", replace(session, urdf_reference="../elsewhere/arm.urdf"))
    assert session.urdf is not None
    assert (tmp_path / "a" / "arm.urdf").read_bytes() == session.urdf.data
    write_session(tmp_path / "b", replace(session, urdf_reference="package://my_arm/arm.urdf"))
    assert sorted(path.name for path in (tmp_path / "b").iterdir()) == [
        "cameras.yaml",
        "detections.csv",
        "joints.csv",
        "session.yaml",
    ]
    assert "package://my_arm/arm.urdf" in (tmp_path / "b" / "session.yaml").read_text()


def test_another_session_is_never_overwritten(tmp_path: Path, session: Session) -> None:
    write_session(tmp_path / "out", session)
    with pytest.raises(OutputError, match=r"out/session.yaml: it is already there"):
        write_session(tmp_path / "out", session)


def test_files_are_put_beside_others_but_not_over_them(tmp_path: Path, session: Session) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    write_session(out, session)
    assert differences(session, read_session(out)) == []
    (out / "session.yaml").unlink()
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(OutputError, match="it is already there"):
        write_session(out, session)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize("exists", [False, True])
def test_a_failed_write_leaves_nothing_behind(
    tmp_path: Path, session: Session, monkeypatch: pytest.MonkeyPatch, exists: bool
) -> None:
    out = tmp_path / "target" / "out"
    out.parent.mkdir()
    if exists:
        out.mkdir()
    rename, renamed = Path.rename, []

    def full_disk(self: Path, target: Path) -> Path:
        renamed.append(self.name)
        if len(renamed) == (3 if exists else 1):
            raise OSError(28, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", full_disk)
    with pytest.raises(OutputError, match="No space left on device"):
        write_session(out, session)
    assert sorted(out.parent.rglob("*")) == ([out] if exists else [])


def test_what_cannot_be_written_is_said(tmp_path: Path, session: Session) -> None:
    with pytest.raises(OutputError, match="cannot write here: No such file or directory"):
        write_session(tmp_path / "no" / "such" / "folder", session)
    with pytest.raises(OutputError, match="has no URDF"):
        write_session(tmp_path / "out", replace(session, urdf=None))
    assert session.rig is not None
    left, right = session.rig.cameras
    numbered = Rig((replace(left, name="cam1"), replace(right, name="cam0")), session.rig.T_cam_world)
    with pytest.raises(CameraError):
        write_session(tmp_path / "out", replace(session, rig=numbered))
    blank = Rig((replace(left, name=" left"), right), session.rig.T_cam_world)
    with pytest.raises(SessionError, match="' left' begins or ends with a blank"):
        write_session(tmp_path / "out", replace(session, rig=blank))
    assert [path.name for path in tmp_path.iterdir()] == ["valid"]


def test_every_key_that_is_read_is_written(tmp_path: Path, session: Session) -> None:
    # Frames are only of an arm that moves; what is left out is written back in test_excluding.py.
    full = replace(
        session,
        targets=(Target("probe", FramePattern()),),
        led_distances=(LedDistance(session.led_names[:2], 0.1, 1e-3),),
        estimate=Estimate("dh", "fixed"),
        joint_models={"zero_offset": True},
        scale_sigma=0.002,
        moved={"base": session.poses[2:4], session.led_names[0]: (session.poses[1],)},
        payload=Payload("tip", 1.2, np.array([0.0, 0.0, 0.05])),
        gravity=np.array([9.81, 0.0, 0.0]),
        gear_ratio={"roll": 121.0},
        about={"serial": "0042", "date": "2026-11-27"},
        scene=(Obstacle("table", np.array([1.0, 0.8, 0.02]), np.array([0.3, 0.0, -0.01]), np.array([0.0, 0.0, 0.1])),),
        torques=np.zeros(session.q.shape),
        previous=session.q[::-1],
    )
    write_session(tmp_path / "out", full)
    written = yaml.safe_load((tmp_path / "out" / "session.yaml").read_text())
    other_tables = {kind.kind for kind in MEASUREMENTS} - {table.kind for table in session.measurements}
    # Distances of places are written in test_sockets.py, where there are places.
    assert set(SessionFile.model_fields) - set(written) == other_tables | {"frames", "exclude", "place_distances"}
    found = read_session(tmp_path / "out")
    assert [vars(box).keys() for box in found.scene] == [vars(box).keys() for box in full.scene]
    for box, other in zip(found.scene, full.scene, strict=True):
        assert box.name == other.name
        for what in ("size", "position", "rpy"):
            np.testing.assert_array_equal(getattr(box, what), getattr(other, what))
    for field in ("led_distances", "estimate", "joint_models", "scale_sigma", "gear_ratio", "about", "moved"):
        assert getattr(found, field) == getattr(full, field), field
