"""What comes out of a file cannot steer a terminal."""

import os
import subprocess
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarslam.core.text import command_line, joined, one_line, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("lidar_top", "lidar_top"),
        ("Größe 测试 ★", "Größe 测试 ★"),
        ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
        ("a\nb\r\tc", "a\\nb\\r\\tc"),
        ("abc\u202egnp.exe", "abc\\u202egnp.exe"),
        ("\x9b31m", "\\x9b31m"),
        ("bad\udcff", "bad\\udcff"),
        ("a\u2028b", "a\\u2028b"),
    ],
)
def test_what_a_terminal_would_act_on_is_spelt_out(text: str, shown: str) -> None:
    assert one_line(text) == shown


@given(st.text())
def test_no_text_holds_a_control_character_afterwards(text: str) -> None:
    for shown in (one_line(text), printable(text).replace("\n", "")):
        assert not [c for c in shown if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp")]
        assert not [
            c for c in shown if unicodedata.bidirectional(c) in ("LRE", "RLE", "LRO", "RLO", "LRI", "RLI", "FSI")
        ]
        shown.encode("utf-8")


def test_lines_of_ours_stay_lines() -> None:
    assert printable("source  a\ntopic  \x1b[2J\n") == "source  a\ntopic  \\x1b[2J\n"


def test_the_middle_of_a_long_text_is_left_out() -> None:
    shown = one_line("begin" + "x" * 100_000 + "end", longest=100)
    assert shown.startswith("begin")
    assert shown.endswith("xend")
    assert len(shown) < 120


def test_a_line_break_in_a_name_is_no_line() -> None:
    assert joined(["written to a\nb", "next"]) == "written to a\\nb\nnext"


@pytest.mark.parametrize(
    "name", ["new\nline", "it's\t\\ \x1b[2J", "plain", "a b", "$HOME\r`x`", os.fsdecode(b"bad\xff'"), "abc\u202egnp"]
)
def test_a_command_with_any_name_is_one_line_that_a_shell_reads_back(name: str) -> None:
    typed = command_line("printf", "%s", name)
    assert typed.isprintable()
    printed = subprocess.run(["bash", "-c", typed], capture_output=True, check=True, env={"LC_ALL": "C.UTF-8"}).stdout
    assert printed == os.fsencode(name)
