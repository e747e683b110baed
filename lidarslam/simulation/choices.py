"""Tables of names that a user chooses from."""

from collections.abc import Mapping
from typing import TypeVar

from lidarslam.core.errors import InputError

T = TypeVar("T")


def choose(kind: str, name: str, table: Mapping[str, T]) -> T:
    """The entry of that name; an InputError lists the names there are."""
    if name not in table:
        raise InputError(f"no {kind} is called {name!r}; there are: {', '.join(table)}")
    return table[name]
