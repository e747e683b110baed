"""YAML gives plain values or an error in a line, whatever it holds."""

from pathlib import Path

import pytest

from lidarslam.config.yaml_text import YamlError, parse_yaml, read_yaml
from lidarslam.core.errors import ConfigError


def test_plain_values() -> None:
    text = "a: {b: [1, 2.5, null, yes]}\nbase: &base {x: 1}\nc:\n  <<: *base\n  x: 2\n"
    assert parse_yaml(text) == {"a": {"b": [1, 2.5, None, True]}, "base": {"x": 1}, "c": {"x": 2}}


@pytest.mark.parametrize("text", ["010", "04", "0x10", "0o10", "0b11", "1:30", "1:30.5", "1_000", "1.", "7e3", "-0"])
def test_a_number_is_decimal_or_a_text(text: str) -> None:
    """In YAML 1.1, 010 is eight and 1:30 ninety."""
    numbers = {"1.": 1.0, "-0": 0}
    assert parse_yaml(text) == numbers.get(text, text)
    assert parse_yaml(f"'{text}'") == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1", "not YAML"),
        ("a: 1\nb: 2\na: 3\n", "the key 'a' occurs twice"),
        ("a: {b: 1, b: 2}", "the key 'b' occurs twice"),
        ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
        ("a: !!python/name:os.system", "could not determine a constructor"),
        ("a: 2021-13-45", "looks like a date or a number but is none"),
        ("a: " + "[" * 3_000 + "]" * 3_000, "nested too deeply"),
        ("a: \x00", "not YAML"),
        ("? [a]\n: 1", "unhashable key"),
    ],
)
def test_anything_else_is_an_error_in_one_line(text: str, message: str) -> None:
    with pytest.raises(YamlError, match=message) as raised:
        parse_yaml(text)
    assert "\n" not in str(raised.value)


def test_aliases_cost_no_more_than_they_are_long() -> None:
    """A "billion laughs" text: nine lists of nine aliases each, 9^9 elements if anyone wrote them out."""
    pairs = zip("abcdefgh", "bcdefghi", strict=True)
    lines = ["a: &a [x]"] + [f"{c}: &{c} [{', '.join(['*' + b] * 9)}]" for b, c in pairs]
    assert len(parse_yaml("\n".join(lines))["i"]) == 9


def test_a_file_that_is_no_text_or_far_too_long(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_yaml(tmp_path / "a.yaml")
    (tmp_path / "b.yaml").write_bytes(b"#" * (5 << 20))
    with pytest.raises(ConfigError, match="longer than 4 MB"):
        read_yaml(tmp_path / "b.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_yaml(tmp_path / "none.yaml")
