"""Shell completion of commands, options and names."""

import pytest
from click.shell_completion import BashComplete, FishComplete, ShellComplete, ZshComplete

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
        ("simulate --sensor hdl-3", ["plain hdl-32e"]),
        ("simulate --motion l", ["plain legged"]),
        ("simulate --format r", ["plain rosbag1", "plain rosbag2"]),
        ("run -c ind", ["file ind", "plain indoor"]),
        ("compare --benchmark sim", ["file sim", "plain simulated"]),
        ("run -c ./x", ["file ./x"]),
        ("info rec", ["file rec"]),
        ("run x -o r", ["file r"]),
        ("evaluate r", ["file r"]),
    ],
)
def test_words_are_completed(line: str, expected: list[str]) -> None:
    assert completed(line) == expected


def test_all_commands_are_offered() -> None:
    assert set(completed("")) == {f"plain {name}" for name in main.commands}


@pytest.mark.parametrize("shell", [BashComplete, ZshComplete, FishComplete])
def test_the_script_of_every_shell_asks_the_program(shell: type[ShellComplete]) -> None:
    script = shell(main, {}, "lidarslam", "_LIDARSLAM_COMPLETE")
    assert f"_LIDARSLAM_COMPLETE={shell.name}_complete" in script.source_template % script.source_vars()
    assert "plain simulated" in completed("compare --benchmark sim", shell)
