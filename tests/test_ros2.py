"""The ROS 2 package, without ROS: files are parsed, and its launch file runs with stand-ins for ROS's modules."""

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from lidarslam.commands.runs import live

PACKAGE = Path(__file__).parents[1] / "ros2"
NAMES = {
    "launch": ["LaunchContext", "LaunchDescription"],
    "launch.actions": ["DeclareLaunchArgument", "ExecuteProcess", "OpaqueFunction"],
    "launch.conditions": ["IfCondition"],
    "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
    "launch_ros": [],
    "launch_ros.actions": ["Node"],
    "launch_ros.substitutions": ["FindPackageShare"],
}


class Recorded:
    """What was constructed, with its arguments; a launch configuration has the value of the context."""

    def __init__(self, *positional: Any, **named: Any) -> None:
        self.positional, self.named = positional, named

    def perform(self, context: dict[str, str]) -> str:
        return context[self.positional[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    for module, names in NAMES.items():
        stand_in = ModuleType(module)
        for name in names:
            setattr(stand_in, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module, stand_in)
    return SimpleNamespace(**runpy.run_path(str(PACKAGE / "launch/lidarslam.launch.py")))


def test_the_launched_command_is_one_of_lidarslam(launch_file):
    arguments = {name: default for name, (default, _) in launch_file.ARGUMENTS.items()}
    context = arguments | {"options": "--base-frame base_link --set reader.time_unit=ns"}
    (process,) = launch_file.start_program(context)
    program, command, *options = process.named["cmd"]
    assert (program, command) == ("lidarslam", "live")
    with live.make_context("live", options) as parsed:
        assert parsed.params["topic"] == "/points"
        assert parsed.params["odom_frame"] == "odom"
        assert parsed.params["base_frame"] == "base_link"


def test_the_launch_has_the_program_the_transform_and_rviz(launch_file):
    (actions,) = launch_file.generate_launch_description().positional
    nodes = {action.named["executable"]: action.named for action in actions if "executable" in action.named}
    declared = [action.positional[0] for action in actions if "default_value" in action.named]
    assert declared == list(launch_file.ARGUMENTS)
    assert nodes["static_transform_publisher"]["arguments"][:2] == ["--frame-id", "map"]
    assert nodes["rviz2"]["remappings"][0][0] == "/points"
    assert any(action.named.get("function") is launch_file.start_program for action in actions)


def test_the_package_names_what_it_starts_and_installs():
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    name = package.findtext("name")
    needed = {element.text for element in package.findall("exec_depend")}
    assert package.get("format") == "3"
    assert {"rviz2", "tf2_ros", "launch_ros"} <= needed
    build = (PACKAGE / "CMakeLists.txt").read_text()
    assert f"project({name} " in build
    assert "DIRECTORY launch rviz" in build
    assert f'FindPackageShare("{name}")' in (PACKAGE / "launch/lidarslam.launch.py").read_text()


def test_rviz_shows_the_topics_of_the_program():
    shown = yaml.safe_load((PACKAGE / "rviz/lidarslam.rviz").read_text())["Visualization Manager"]
    assert shown["Global Options"]["Fixed Frame"] == "map"
    topics = {display["Topic"]["Value"] for display in shown["Displays"] if "Topic" in display}
    assert topics == {"/lidarslam/odometry", "/points"}
