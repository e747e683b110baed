"""Names that become parts of paths."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarslam.core.errors import ConfigError
from lidarslam.core.text import require_name, safe_name, stays_below

UNSAFE = ["", " ", ".", "..", "...", ".hidden", "/abs/path", "../../x", "a/b", "a\\b", "a\0b", "a\nb", "\x1b[2J",
          "\ud800", "\u202eabc", "x" * 121, "\u00e4" * 61]  # fmt: skip


@pytest.mark.parametrize("name", UNSAFE)
def test_unsafe_names_are_refused_by_name(name: str) -> None:
    with pytest.raises(ConfigError, match=r"method .* cannot be the name of a folder"):
        require_name(name, "method")


@pytest.mark.parametrize(
    "name", ["04", "kiss-icp@0.5", "a+map+graph", "p2pl + pl2pl", "stra\u00dfe", "a..b", "x" * 120]
)
def test_other_names_stay(name: str) -> None:
    assert require_name(name, "method") == name
    assert safe_name(name) == name


def test_reserved_names_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"'recordings': .*another file"):
        require_name("recordings", "recording", {"recordings"})


def test_a_path_that_stays_below_its_folder() -> None:
    assert [path for path in ("a", "a/b.bin", "./a", "a..b/..c") if not stays_below(path)] == []
    assert [path for path in ("..", "../a", "a/../../b", "/a", "//a", "a/..") if stays_below(path)] == []


@given(st.text(max_size=300))
def test_a_safe_name_stays_in_its_folder(text: str) -> None:
    name = safe_name(text)
    path = Path("/folder") / name
    assert path.parent == Path("/folder")
    assert name == require_name(name, "recording")


def test_safe_names_are_told_apart() -> None:
    assert [safe_name(text) for text in ("hilti/basement_2", "..", "/points", " ")] == [
        "hilti_basement_2", "recording", "_points", "recording",
    ]  # fmt: skip
