"""Bounds of settings, as declared beside their fields."""

from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Le
from pydantic.fields import FieldInfo


def bounds_of(field: FieldInfo) -> tuple[float, float] | None:
    """The least and the largest value of a number, also where it may be null or lies in a tuple; None of no number."""
    marks = list(_marks(field.metadata, field.annotation))
    low = next((mark.ge for mark in marks if isinstance(mark, Ge)), None)
    high = next((mark.le for mark in marks if isinstance(mark, Le)), None)
    return None if low is None or high is None else (low, high)  # type: ignore[return-value] # they are numbers


def bounds_text(field: FieldInfo) -> str | None:
    """The bounds in words, such as `0.01 to 10` or `[3 numbers, 0 to 1]`, with the words that may stand instead.

    None of no number.
    """
    bounds = bounds_of(field)
    if bounds is None:
        return None
    words = [word for kind in get_args(field.annotation) if get_origin(kind) is Literal for word in get_args(kind)]
    numbers = " to ".join(f"{b:,.0f}" if b == int(b) else f"{b:g}" for b in bounds)
    length = next((len(get_args(kind)) for kind in get_args(field.annotation) if get_origin(kind) is tuple), None)
    return " or ".join([numbers if length is None else f"[{length} numbers, {numbers}]", *words])


def _marks(metadata: list[Any], annotation: Any) -> Iterator[Any]:
    for mark in metadata:
        yield from mark.metadata if isinstance(mark, FieldInfo) else (mark,)
    for part in get_args(annotation):
        yield from _marks(list(getattr(part, "__metadata__", ())), part)
