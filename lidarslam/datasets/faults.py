"""Faults of a recording's scans, counted while they are read."""

from dataclasses import dataclass, field

from lidarslam.core.errors import InputError

NO_POINT_TIME = "scans have no usable times of points and are taken as measured at one instant"
_UNREADABLE = "scans were left out: not readable"
# Of the words of a kind before its colon, for a single scan.
_SINGULAR = {
    "scans": "scan",
    "places": "place",
    "were": "was",
    "are": "is",
    "have": "has",
    "look": "looks",
    "turn": "turns",
}


@dataclass
class Faults:
    """The faults of one pass through a recording, counted by kind; of each kind the first is remembered."""

    strict: bool = False  # a scan that cannot be read is an error
    left_out: int = 0  # number of scans that were left out
    unreadable_scans: int = 0  # number of these that are damaged or missing
    _counts: dict[str, int] = field(default_factory=dict)
    _first: dict[str, str] = field(default_factory=dict)

    def leave_out(self, kind: str, example: str, count: int = 1, is_readable: bool = True) -> None:
        """Count scans that are left out; the kind completes a sentence that begins with their number."""
        self.left_out += count
        self.unreadable_scans += 0 if is_readable else count
        self.note(kind, example, count)

    def unreadable(self, error: InputError) -> None:
        """Count one scan that is left out because it cannot be read; where it is strict, raise the error."""
        if self.strict:
            raise error
        self.leave_out(_UNREADABLE, str(error), is_readable=False)

    def note(self, kind: str, example: str, count: int = 1) -> None:
        """Count scans that are used in spite of a fault."""
        self._counts[kind] = self._counts.get(kind, 0) + count
        self._first.setdefault(kind, example)

    def warnings(self) -> tuple[str, ...]:
        """A line for each kind, with its count, in the order they were met."""
        return tuple(f"{_counted(n, kind)}; the first: {self._first[kind]}" for kind, n in self._counts.items())


def _counted(number: int, kind: str) -> str:
    said, colon, why = kind.partition(":")
    if number == 1:
        said = " ".join(_SINGULAR.get(word, word) for word in said.split(" "))
    return f"{number:,} {said}{colon}{why}"
