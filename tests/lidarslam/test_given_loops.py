"""Loop closures given and forbidden on the command line of a run."""

from pathlib import Path
from typing import Any

import pytest

from lidarslam.config.settings import read_yaml

from ..conftest import succeeds
from .conftest import FAST, refused, summary_of


def command(source: Path, out: Path, *arguments: object) -> list[object]:
    return ["run", source, "--out", out, *FAST, "--set", "pose_graph.keyframes.distance_m=0.1", *arguments]


def loops(out: Path) -> list[dict[str, Any]]:
    return list(summary_of(out)["pose_graph"]["loops"])


def test_a_given_loop_is_closed_and_part_of_the_run(small_recording: Path, tmp_path: Path) -> None:
    out, given = tmp_path / "run", ("--loop", 5, 0, "--no-loop", 1, 4)
    assert "not closed" not in succeeds(*command(small_recording, out, *given))
    (loop,) = [one for one in loops(out) if one["found_by"] == "given"]
    assert (loop["first_scan"], loop["accepted"]) == (0, True)
    described = read_yaml(out / "config.yaml")
    assert (described["run"]["loops"], described["run"]["no_loops"]) == ([[0, 5]], [[1, 4]])
    assert described["pose_graph"]["enabled"]
    assert "is finished already" in succeeds(*command(small_recording, out, *given, "--resume"))
    assert "holds another finished run" in refused(*command(small_recording, out, "--loop", 5, 1, "--resume"))


@pytest.mark.parametrize(
    ("overlap", "pair", "reason"),
    [("1.0", (0, 5), "of the points in view are inliers"), ("0.75", (4, 5), "no keyframe lies between the scans")],
)
def test_a_loop_that_cannot_be_closed_is_said_in_a_line(
    small_recording: Path, tmp_path: Path, overlap: str, pair: tuple[int, int], reason: str
) -> None:
    distance = () if pair == (0, 5) else ("--set", "pose_graph.keyframes.distance_m=50")
    given = ("--loop", *pair, "--set", f"pose_graph.loops.min_overlap={overlap}", *distance)
    said = succeeds(*command(small_recording, tmp_path / "run", *given))
    (line,) = [line for line in said.splitlines() if "--loop" in line]
    assert line.startswith(f"warning: --loop {pair[0]} {pair[1]} was not closed: ")
    assert reason in line
    assert not any(loop["accepted"] for loop in loops(tmp_path / "run"))
