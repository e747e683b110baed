"""Loop closures given and forbidden on the command line of a run."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from lidarslam.config.yaml_text import read_yaml

from ..conftest import lidarslam

FAST = ("--odometry", "constant-velocity", "--no-report", "--set", "pose_graph.keyframes.distance_m=0.1")


def run(source: Path, out: Path, *arguments: object) -> Result:
    return lidarslam("run", source, "--out", out, *FAST, *arguments)


def loops(out: Path) -> list[dict[str, Any]]:
    return list(json.loads((out / "summary.json").read_text())["pose_graph"]["loops"])


def test_a_given_loop_is_closed_and_part_of_the_run(small_recording: Path, tmp_path: Path) -> None:
    out, given = tmp_path / "run", ("--loop", 5, 0, "--no-loop", 1, 4)
    ran = run(small_recording, out, *given)
    assert ran.exit_code == 0, ran.output
    assert "not closed" not in ran.output
    (loop,) = [one for one in loops(out) if one["found_by"] == "given"]
    assert (loop["first_scan"], loop["accepted"]) == (0, True)
    described = read_yaml(out / "config.yaml")
    assert (described["run"]["loops"], described["run"]["no_loops"]) == ([[0, 5]], [[1, 4]])
    assert described["pose_graph"]["enabled"]
    assert "is finished already" in run(small_recording, out, *given, "--resume").stdout
    other = run(small_recording, out, "--loop", 5, 1, "--resume")
    assert (other.exit_code, "holds another finished run" in other.stderr) == (1, True)


@pytest.mark.parametrize(
    ("overlap", "pair", "reason"),
    [("1.0", (0, 5), "of the points in view are inliers"), ("0.75", (4, 5), "no keyframe lies between the scans")],
)
def test_a_loop_that_cannot_be_closed_is_said_in_a_line(
    small_recording: Path, tmp_path: Path, overlap: str, pair: tuple[int, int], reason: str
) -> None:
    distance = () if pair == (0, 5) else ("--set", "pose_graph.keyframes.distance_m=50")
    given = ("--loop", *pair, "--set", f"pose_graph.loops.min_overlap={overlap}", *distance)
    ran = run(small_recording, tmp_path / "run", *given)
    assert ran.exit_code == 0, ran.output
    (line,) = [line for line in ran.stdout.splitlines() if "--loop" in line]
    assert line.startswith(f"warning: --loop {pair[0]} {pair[1]} was not closed: ")
    assert reason in line
    assert not any(loop["accepted"] for loop in loops(tmp_path / "run"))
