"""What is wrong with the scans of a recording, counted while they are read."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan

T = TypeVar("T")

NO_POINT_TIME = "scans have no usable times of their points and are taken as measured at one instant"
_UNREADABLE = "scans were left out: they could not be read"


@dataclass
class _Kind:
    """How often something was met, and how it was when it was met first."""

    first: str
    count: int = 0


@dataclass
class Faults:
    """The faults of one pass through a recording, counted by kind; of each kind the first is remembered.

    Attributes:
        left_out: how many scans were left out.
    """

    left_out: int = 0
    _kinds: dict[str, _Kind] = field(default_factory=dict)

    def leave_out(self, kind: str, example: str, count: int = 1) -> None:
        """So many scans less; the kind completes a sentence that begins with how many there are."""
        self.left_out += count
        self.note(kind, example, count)

    def unreadable(self, error: InputError) -> None:
        """One scan less, because it cannot be read."""
        self.leave_out(_UNREADABLE, str(error))

    def note(self, kind: str, example: str, count: int = 1) -> None:
        """So many scans that are taken in spite of something."""
        self._kinds.setdefault(kind, _Kind(example)).count += count

    def warnings(self) -> tuple[str, ...]:
        """A line for each kind, with its count, in the order they were met."""
        return tuple(f"{kind.count} {name}; the first: {kind.first}" for name, kind in self._kinds.items())


def readable_scans(items: Iterable[T], read: Callable[[T], Scan], faults: Faults | None) -> Iterator[Scan]:
    """The scans read of these items; one that cannot be read is counted and left out, or raised where nobody counts.

    Raises:
        InputError: a scan cannot be read and `faults` is None.
    """
    for item in items:
        try:
            scan = read(item)
        except InputError as error:
            if faults is None:
                raise
            faults.unreadable(error)
            continue
        yield scan


def first_readable(source: Path, items: Iterable[T], read: Callable[[T], Scan]) -> tuple[T, Scan, Faults]:
    """The first item that a scan can be read of, that scan, and what is wrong with those before it.

    Raises:
        InputError: none can be read; the first one's error.
    """
    faults, first_error = Faults(), None
    for item in items:
        try:
            return item, read(item), faults
        except InputError as error:
            first_error = first_error or error
            faults.unreadable(error)
    raise first_error or InputError(f"{source}: holds no scan that could be used; record it again")
