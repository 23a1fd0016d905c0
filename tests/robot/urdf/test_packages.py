from __future__ import annotations

import os
from pathlib import Path

import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.urdf.packages import find_urdf, package_roots


@pytest.fixture(autouse=True)
def no_ros(monkeypatch):
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


def package(folder: Path, name: str | None = None) -> Path:
    (folder / "urdf").mkdir(parents=True)
    (folder / "package.xml").write_text(f"<package><!-- --><name> {name or folder.name} </name></package>")
    (folder / "urdf" / "arm.urdf").write_text("<robot/>")
    return folder


def search(monkeypatch, variable, *folders):
    monkeypatch.setenv(variable, os.pathsep.join(str(folder) for folder in folders))


def test_a_plain_path_is_taken_as_it_is_or_from_the_given_folder(tmp_path):
    package(tmp_path / "arm")
    assert find_urdf(tmp_path / "arm/urdf/arm.urdf") == tmp_path / "arm/urdf/arm.urdf"
    assert find_urdf("urdf/arm.urdf", relative_to=tmp_path / "arm") == tmp_path / "arm/urdf/arm.urdf"


def test_a_missing_file_is_reported_with_what_lies_beside_it(tmp_path):
    package(tmp_path / "arm")
    with pytest.raises(RobotError, match=r"nothing\.urdf: there is no such file\. That folder has: arm\.urdf"):
        find_urdf(tmp_path / "arm/urdf/nothing.urdf")
    with pytest.raises(RobotError, match=r"There is no folder .*nowhere"):
        find_urdf(tmp_path / "nowhere/arm.urdf")
    with pytest.raises(RobotError, match=r"this is a folder.*That folder has: arm\.urdf"):
        find_urdf(tmp_path / "arm/urdf")


@pytest.mark.parametrize("name", ["x" * 5000, "nul\0l"])
def test_an_impossible_file_name_is_a_missing_file(name):
    with pytest.raises(RobotError, match="there is no such file"):
        find_urdf(name)


@pytest.mark.parametrize("depth", ["", "src", "src/repository", "src/repository/group"])
def test_ros_package_path_may_name_a_workspace(tmp_path, monkeypatch, depth):
    arm = package(tmp_path / depth / "arm")
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path / "not there", tmp_path)
    assert find_urdf("package://arm/urdf/arm.urdf") == arm / "urdf/arm.urdf"
    assert arm.parent in package_roots()


def test_ros_package_path_may_name_the_package_itself(tmp_path, monkeypatch):
    arm = package(tmp_path / "arm")
    search(monkeypatch, "ROS_PACKAGE_PATH", arm)
    assert find_urdf("package://arm/urdf/arm.urdf") == arm / "urdf/arm.urdf"
    assert package_roots()[0] == tmp_path


def test_a_folder_without_package_xml_is_found_too_as_pinocchio_does(tmp_path, monkeypatch):
    package(tmp_path / "arm")
    (tmp_path / "arm/package.xml").unlink()
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    assert find_urdf("package://arm/urdf/arm.urdf").is_file()


def test_a_package_may_have_another_name_than_its_folder(tmp_path, monkeypatch):
    clone = package(tmp_path / "src" / "arm-main", name="arm")
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    assert find_urdf("package://arm/urdf/arm.urdf") == clone / "urdf/arm.urdf"


def test_ignored_and_hidden_folders_are_not_searched(tmp_path, monkeypatch):
    package(tmp_path / "old" / "arm")
    (tmp_path / "old" / "CATKIN_IGNORE").touch()
    package(tmp_path / ".git" / "arm")
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    with pytest.raises(RobotError, match="there is no package 'arm'"):
        find_urdf("package://arm/urdf/arm.urdf")


def test_a_ring_of_links_does_not_hang_the_search(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "back").symlink_to(tmp_path, target_is_directory=True)
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    with pytest.raises(RobotError, match="there is no package 'arm'"):
        find_urdf("package://arm/urdf/arm.urdf")


def test_ament_prefix_path_names_prefixes(tmp_path, monkeypatch):
    arm = package(tmp_path / "install" / "share" / "arm")
    search(monkeypatch, "AMENT_PREFIX_PATH", tmp_path / "install")
    assert find_urdf("package://arm/urdf/arm.urdf") == arm / "urdf/arm.urdf"


def test_the_first_package_that_has_the_file_wins(tmp_path, monkeypatch):
    overlay, underlay = package(tmp_path / "overlay" / "arm"), package(tmp_path / "underlay" / "arm")
    search(monkeypatch, "ROS_PACKAGE_PATH", overlay.parent, underlay.parent)
    assert find_urdf("package://arm/urdf/arm.urdf") == overlay / "urdf/arm.urdf"
    (overlay / "urdf/arm.urdf").unlink()
    assert find_urdf("package://arm/urdf/arm.urdf") == underlay / "urdf/arm.urdf"


def test_example_robot_data_is_found_without_any_variable():
    path = find_urdf("package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf")
    assert path.is_file()
    assert package_roots() == [Path(*path.parts[: path.parts.index("example-robot-data")])]


def test_a_missing_package_is_reported_with_what_was_searched(tmp_path, monkeypatch):
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    with pytest.raises(RobotError) as caught:
        find_urdf("package://arm/urdf/arm.urdf")
    for part in (
        "'arm'",
        f"ROS_PACKAGE_PATH ({tmp_path})",
        "AMENT_PREFIX_PATH (not set)",
        "example-robot-data",
    ):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    "reference",
    [
        "package://arm/../secret.urdf",
        "package://arm/urdf/../../secret.urdf",
        "package://arm/..",
        "package://arm//../secret.urdf",
    ],
)
def test_no_reference_leads_out_of_its_package(tmp_path, monkeypatch, reference):
    package(tmp_path / "arm")
    (tmp_path / "secret.urdf").write_text("<robot/>")
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    with pytest.raises(RobotError, match="leads out of package 'arm'"):
        find_urdf(reference)


def test_dots_that_stay_inside_a_package_are_fine(tmp_path, monkeypatch):
    arm = package(tmp_path / "arm")
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    assert find_urdf("package://arm/meshes/../urdf//./arm.urdf") == arm / "urdf/arm.urdf"


def test_an_absolute_path_behind_a_package_stays_in_it(tmp_path, monkeypatch):
    package(tmp_path / "arm")
    search(monkeypatch, "ROS_PACKAGE_PATH", tmp_path)
    with pytest.raises(RobotError, match="there is no such file"):
        find_urdf(f"package://arm/{tmp_path}/arm/urdf/arm.urdf")


@pytest.mark.parametrize("reference", ["package://", "package:///urdf/arm.urdf", "package://../arm/arm.urdf"])
def test_a_reference_names_a_package(reference):
    with pytest.raises(RobotError, match="no package is named"):
        find_urdf(reference)
