"""JSON of unknown origin."""

from typing import Any

import pytest
from pydantic import TypeAdapter

from lidarslam.core import json_text
from lidarslam.core.json_text import ANY_OBJECT, parse_json, read_json


@pytest.mark.parametrize(("text", "message"), [
    ("[" * 100_000, "nested too deeply"), ('{"a": [1e999]}', "not finite"), ('{"a": NaN}', "not finite"),
    ('{"a": ' + "9" * 5_000 + "}", "4300 digits"), ("", "Expecting value"), ("[1]", "valid dictionary"),
], ids=range(6))  # fmt: skip
def test_what_is_not_plain_is_a_value_error_of_one_line(text, message):
    with pytest.raises(ValueError, match=message) as refused:
        parse_json(text, ANY_OBJECT)
    assert "\n" not in str(refused.value)


def test_a_fault_of_shape_has_its_place():
    with pytest.raises(ValueError, match=r"^a\.1: Input should be a valid integer"):
        parse_json('{"a": [1, "b"]}', TypeAdapter(dict[str, list[int]]))


def test_plain_values_are_as_they_are(tmp_path, monkeypatch):
    values: dict[str, Any] = {"a": [1, -(2**62), 0.5, None, True, "stra\u00dfe"], "b": {"c": []}}
    file = tmp_path / "file.json"
    file.write_text('{"a": [1, -4611686018427387904, 0.5, null, true, "straße"], "b": {"c": []}}')
    assert read_json(file, ANY_OBJECT) == values
    monkeypatch.setattr(json_text, "_LONGEST_BYTES", 50)
    with pytest.raises(ValueError, match="longer than"):
        read_json(file, ANY_OBJECT)
