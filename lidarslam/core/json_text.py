"""JSON of unknown origin: bounded in length and depth, finite numbers, texts that names can be made of, a known shape.

The only place where files of JSON are parsed.
"""

import json
import math
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from lidarslam.core.text import one_line

T = TypeVar("T")

ANY_OBJECT = TypeAdapter(dict[str, Any])

# Of a summary with 100,000 loop closures, or the largest table of nuScenes that is read as a whole.
_LONGEST_BYTES = 64 << 20
_DEEPEST = 100
_LARGEST_INTEGER = 1 << 63


def read_json(path: Path, shape: TypeAdapter[T], any_path: bool = False) -> T:
    """The content of a file in UTF-8; arguments as of `parse_json`.

    OSError where it cannot be read; ValueError where it is too long, as `parse_json`.
    """
    with path.open("rb") as file:
        content = file.read(_LONGEST_BYTES + 1)
    if len(content) > _LONGEST_BYTES:
        raise ValueError(f"longer than {_LONGEST_BYTES >> 20} MB")
    return parse_json(content, shape, any_path=any_path)


def parse_json(text: str | bytes, shape: TypeAdapter[T], any_number: bool = False, any_path: bool = False) -> T:
    """The values of a text in UTF-8.

    Args:
        text, shape: to be parsed, and of the values.
        any_number: whether numbers may be infinite, NaN, or of any length.
        any_path: whether texts may be paths that are not UTF-8, as Python has them: each such byte as half of a pair.

    Raises:
        ValueError: it is not JSON, is nested too deeply, has another shape, a number that is not finite, an integer
            beyond 64 bits, or a text with NUL or half of a surrogate pair; the message is one line.
    """
    try:
        values = json.loads(text if isinstance(text, str) else text.decode("utf-8"))
    except RecursionError:
        raise ValueError("nested too deeply") from None
    _require_plain(values, any_number, "surrogateescape" if any_path else "strict")
    try:
        return shape.validate_python(values)
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(map(str, fault["loc"]))
        raise ValueError(one_line(f"{place}: {fault['msg']}" if place else fault["msg"])) from None


def _require_plain(values: Any, any_number: bool, errors: str) -> None:
    """Go through the values level by level."""
    level = [values]
    for _ in range(_DEEPEST):
        inner: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                inner += value
                inner += value.values()
            elif isinstance(value, list):
                inner += value
            elif isinstance(value, str):
                if "\0" in value:
                    raise ValueError("a text has a NUL character")
                value.encode(errors=errors)  # half of a surrogate pair raises a ValueError
            elif isinstance(value, float) and not any_number and not math.isfinite(value):
                raise ValueError("a number is not finite")
            elif isinstance(value, int) and not any_number and abs(value) >= _LARGEST_INTEGER:
                raise ValueError("an integer has more than 64 bits")
        if not inner:
            return
        level = inner
    raise ValueError("nested too deeply")
