"""JSON of unknown origin."""

import os
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from lidarslam.core import json_text
from lidarslam.core.json_text import ANY_OBJECT, parse_json, read_json

REFUSED = {
    "deep": ("[" * 100_000, "nested too deeply"),
    "deep and whole": ('{"a": ' + "[" * 900 + "]" * 900 + "}", "nested too deeply"),
    "infinite": ('{"a": [1e999]}', "not finite"),
    "nan": ('{"a": NaN}', "not finite"),
    "long number": ('{"a": ' + "9" * 5_000 + "}", "4300 digits"),
    "large number": ('{"a": 99999999999999999999}', "64 bits"),
    "nul": ('{"a": "x\\u0000"}', "NUL"),
    "nul in a name": ('{"\\u0000": 1}', "NUL"),
    "surrogate": ('{"a": "\\ud800"}', "surrogates"),
    "bytes": (b'{"a": "\xff"}', "can't decode"),
    "empty": ("", "Expecting value"),
    "shape": ("[1]", "valid dictionary"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_plain_is_a_value_error_of_one_line(name: str) -> None:
    text, message = REFUSED[name]
    with pytest.raises(ValueError, match=message) as refused:
        parse_json(text, ANY_OBJECT)
    assert "\n" not in str(refused.value)


def test_paths_that_are_no_utf_8_are_read_where_they_may_be() -> None:
    text = '{"a": "drive \\udcff"}'
    assert parse_json(text, ANY_OBJECT, any_path=True) == {"a": os.fsdecode(b"drive \xff")}
    with pytest.raises(ValueError, match="surrogates"):
        parse_json(text, ANY_OBJECT)
    with pytest.raises(ValueError, match="surrogates"):
        parse_json('{"a": "\\ud800"}', ANY_OBJECT, any_path=True)


def test_a_fault_of_shape_has_its_place() -> None:
    with pytest.raises(ValueError, match=r"^a\.1: Input should be a valid integer"):
        parse_json('{"a": [1, "b"]}', TypeAdapter(dict[str, list[int]]))


def test_plain_values_are_as_they_are(tmp_path: Path) -> None:
    values: dict[str, Any] = {"a": [1, -(2**62), 0.5, None, True, "stra\u00dfe"], "b": {"c": []}}
    (tmp_path / "file.json").write_text('{"a": [1, -4611686018427387904, 0.5, null, true, "straße"], "b": {"c": []}}')
    assert read_json(tmp_path / "file.json", ANY_OBJECT) == values


def test_a_file_that_is_far_too_long_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_text, "_LONGEST_BYTES", 1 << 20)
    (tmp_path / "file.json").write_text(f'{{"a": {" " * (1 << 20)}1}}')
    with pytest.raises(ValueError, match="longer than 1 MB"):
        read_json(tmp_path / "file.json", ANY_OBJECT)
