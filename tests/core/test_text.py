"""Text of unknown origin cannot steer a terminal or leave a folder; hints can be typed."""

import os
import shutil
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarslam.core import text as texts
from lidarslam.core.errors import ConfigError


@pytest.mark.parametrize(("text", "shown"), [
    ("lidar_top", "lidar_top"), ("Größe 测试 ★", "Größe 测试 ★"), ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
    ("a\nb\r\tc", "a\\nb\\r\\tc"), ("abc\u202egnp.exe", "abc\\u202egnp.exe"), ("\x9b31m", "\\x9b31m"),
    ("bad\udcff", "bad\\udcff"), ("a\u2028b", "a\\u2028b"),
])  # fmt: skip
def test_what_a_terminal_would_act_on_is_spelt_out(text, shown):
    assert texts.one_line(text) == shown


@given(st.text())
def test_no_text_holds_a_control_character_afterwards(text):
    directions = {"LRE", "RLE", "LRO", "RLO", "LRI", "RLI", "FSI"}
    for shown in (texts.one_line(text), texts.printable(text).replace("\n", "")):
        assert not [c for c in shown if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp")]
        assert not [c for c in shown if unicodedata.bidirectional(c) in directions]
        shown.encode("utf-8")


def test_lines_of_ours_stay_lines_and_line_breaks_in_names_become_none():
    assert texts.printable("source  a\ntopic  \x1b[2J\n") == "source  a\ntopic  \\x1b[2J\n"
    assert texts.joined(["written to a\nb", "next"]) == "written to a\\nb\nnext"


@pytest.mark.parametrize(
    "name", ["new\nline", "it's\t\\ \x1b[2J", "plain", "a b", "$HOME\r`x`", os.fsdecode(b"bad\xff'"), "abc\u202egnp"]
)
def test_a_command_with_any_name_is_one_line_that_a_shell_reads_back(name):
    typed = texts.command_line("printf", "%s", name)
    assert typed.isprintable()
    printed = subprocess.run(["bash", "-c", typed], capture_output=True, check=True, env={"LC_ALL": "C.UTF-8"}).stdout
    assert printed == os.fsencode(name)


UNSAFE = ["", " ", ".", "..", "...", ".hidden", "/abs/path", "../../x", "a/b", "a\\b", "a\0b", "a\nb", "\x1b[2J",
          "\ud800", "\u202eabc", "x" * 121, "\u00e4" * 61]  # fmt: skip


@pytest.mark.parametrize("name", UNSAFE)
def test_unsafe_names_are_refused_by_name(name):
    with pytest.raises(ConfigError, match=r"method .* cannot be the name of a folder"):
        texts.require_name(name, "method")


@pytest.mark.parametrize(
    "name", ["04", "kiss-icp@0.5", "a+map+graph", "p2pl + pl2pl", "stra\u00dfe", "a..b", "x" * 120]
)
def test_other_names_stay(name):
    assert texts.require_name(name, "method") == name
    assert texts.safe_name(name) == name


def test_a_path_that_stays_below_its_folder():
    assert [path for path in ("a", "a/b.bin", "./a", "a..b/..c") if not texts.stays_below(path)] == []
    assert [path for path in ("..", "../a", "a/../../b", "/a", "//a", "a/..") if texts.stays_below(path)] == []


@given(st.text(max_size=300))
def test_a_safe_name_stays_in_its_folder(text):
    name = texts.safe_name(text)
    path = Path("/folder") / name
    assert path.parent == Path("/folder")
    assert name == texts.require_name(name, "recording")


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The programs of an environment that is not on the path, seen from the folder it lies in."""
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("python", "lidarslam"):
        (programs / name).write_text("#!/bin/sh\n")
        (programs / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(programs / "python"))
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.chdir(tmp_path)
    return programs


def test_a_program_is_named_by_its_file_where_the_shell_does_not_find_it(environment, tmp_path, monkeypatch):
    assert texts.as_typed("lidarslam") == "./.venv/bin/lidarslam"
    assert texts.as_typed("rerun") == "rerun", "it is not beside"
    other = shutil.copytree(environment, tmp_path / "other")
    for path, typed in ((environment, "lidarslam"), (other, "./.venv/bin/lidarslam")):
        monkeypatch.setenv("PATH", str(path))
        assert texts.as_typed("lidarslam") == typed
    monkeypatch.chdir("/usr")
    assert texts.as_typed("lidarslam") == str(environment / "lidarslam")


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.0, "less than 0.1 mm"), (8.6e-14, "less than 0.1 mm"), (0.0005, "up to 0.5 mm"), (0.24, "up to 24 cm")],
)
def test_a_bound_of_a_length(metres, text):
    assert texts.up_to(metres) == text
