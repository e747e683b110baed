"""Shell completion of commands, options and names."""

import pytest
from click.shell_completion import BashComplete, ShellComplete

from lidarslam.cli import main


def completed(line: str, shell: type[ShellComplete] = BashComplete) -> list[str]:
    """Type and value of each completion of the last word."""
    *words, last = line.split(" ")
    completions = shell(main, {}, "lidarslam", "_LIDARSLAM_COMPLETE").get_completions(words, last)
    return [f"{item.type} {item.value}" for item in completions]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ru", ["plain run"]),
        ("ev", ["plain evaluate"]),
        ("run --res", ["plain --resume"]),
        ("run --odometry k", ["plain kiss-icp"]),
        ("run --mapping ", ["plain surfels", "plain loam", "plain off"]),
        ("run x --reader kitti", ["plain kitti-odometry", "plain kitti-360", "plain kitti-raw"]),
        ("simulate --world t", ["plain tunnel", "plain terrace", "plain town"]),
        ("run -c ind", ["file ind", "plain indoor"]),
        ("compare --benchmark sim", ["file sim", "plain simulated"]),
        ("run -c ./x", ["file ./x"]),
        ("run x -o r", ["file r"]),
    ],
)
def test_words_are_completed(line: str, expected: list[str]) -> None:
    assert completed(line) == expected
