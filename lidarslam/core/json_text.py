"""JSON of unknown origin, parsed here alone: bounded in length, finite numbers, a known shape."""

import json
import math
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import TypeAdapter, ValidationError

from lidarslam.core.text import one_line

T = TypeVar("T")

ANY_OBJECT = TypeAdapter(dict[str, Any])

# Of a summary with 100,000 loop closures, or the largest table of nuScenes that is read as a whole.
_LONGEST_BYTES = 64 << 20


def read_json(path: Path, shape: TypeAdapter[T]) -> T:
    """The content of a file; OSError where it cannot be read; ValueError where it is too long, as `parse_json`."""
    with path.open("rb") as file:
        content = file.read(_LONGEST_BYTES + 1)
    if len(content) > _LONGEST_BYTES:
        raise ValueError(f"longer than {_LONGEST_BYTES >> 20} MB")
    return parse_json(content, shape)


def parse_json(text: str | bytes, shape: TypeAdapter[T]) -> T:
    """Values of a shape; ValueError where the text is not JSON, has another shape, or a number is not finite."""
    try:
        values = json.loads(text, parse_float=_finite, parse_constant=_not_finite)
        return shape.validate_python(values)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(map(str, fault["loc"]))
        raise ValueError(one_line(f"{place}: {fault['msg']}" if place else fault["msg"])) from None


def _finite(text: str) -> float:
    return number if math.isfinite(number := float(text)) else _not_finite(text)


def _not_finite(_text: str) -> NoReturn:
    raise ValueError("a number is not finite")
