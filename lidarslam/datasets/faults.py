"""Faults of a recording's scans, counted while they are read."""

from dataclasses import dataclass, field
from typing import TypeVar

from lidarslam.core.errors import InputError

T = TypeVar("T")

NO_POINT_TIME = "scans have no usable times of their points and are taken as measured at one instant"
_UNREADABLE = "scans were left out: they could not be read"
# Of the kinds, for a single scan.
_SINGULAR = (
    ("scans of more than 1,048,576 points were", "scan of more than 1,048,576 points was"),
    ("scans were", "scan was"),
    ("scans are", "scan is"),
    ("scans have", "scan has"),
    ("scans look", "scan looks"),
    ("scans turn", "scan turns"),
    ("places in the bag were", "place in the bag was"),
    ("they co", "it co"),
    ("it come", "it comes"),
    ("their stamps were", "its stamp was"),
    ("their stamps are", "its stamp is"),
    ("and are taken", "and is taken"),
    ("and carry", "and carries"),
    ("their points", "its points"),
    ("outside their sweeps", "outside its sweep"),
)


@dataclass
class Faults:
    """The faults of one pass through a recording, counted by kind; of each kind the first is remembered."""

    left_out: int = 0  # number of scans that were left out
    _counts: dict[str, int] = field(default_factory=dict)
    _first: dict[str, str] = field(default_factory=dict)

    def leave_out(self, kind: str, example: str, count: int = 1) -> None:
        """Count scans that are left out; the kind completes a sentence that begins with their number."""
        self.left_out += count
        self.note(kind, example, count)

    def unreadable(self, error: InputError) -> None:
        """Count one scan that is left out because it cannot be read."""
        self.leave_out(_UNREADABLE, str(error))

    def note(self, kind: str, example: str, count: int = 1) -> None:
        """Count scans that are used in spite of a fault."""
        self._counts[kind] = self._counts.get(kind, 0) + count
        self._first.setdefault(kind, example)

    def warnings(self) -> tuple[str, ...]:
        """A line for each kind, with its count, in the order they were met."""
        return tuple(f"{_counted(n, kind)}; the first: {self._first[kind]}" for kind, n in self._counts.items())


def _counted(number: int, kind: str) -> str:
    if number == 1:
        for several, one in _SINGULAR:
            kind = kind.replace(several, one)
    return f"{number:,} {kind}"
