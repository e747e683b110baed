"""Text of unknown origin on a terminal and in paths: names made safe, numbers with nouns, programs as typed."""

import os
import re
import shlex
import shutil
import sys
from collections.abc import Collection, Iterable, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath

from lidarslam.core.errors import ConfigError

# Control characters control terminals, bidirectional marks reorder text, lone surrogates cannot be encoded.
_UNSEEN = (
    "\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\ufff9-\ufffb\U000e0000-\U000e007f"
)
_STEERING = re.compile(f"[{_UNSEEN}]")
_STEERING_BUT_LINES = re.compile(f"(?!\n)[{_UNSEEN}]")

# Longer lines are cut in the middle.
_LONGEST = 2_000
_TAIL = 400
# Bytes; file systems allow 255, and a number, a time or a suffix may follow.
_LONGEST_NAME = 120
_SEPARATORS = re.compile(r"[/\\]+")
_NAME_REMEDY = (
    "name it with letters, digits, '-', '_', '.' or '+', without a dot at the beginning, and unlike the report's files"
)


def one_line(text: str, longest: int = _LONGEST) -> str:
    """The text in one line: control characters are escaped, as in `\\x1b`, and a long middle is left out."""
    spelt = _STEERING.sub(_spelt, text)
    if len(spelt) <= longest:
        return spelt
    tail = min(_TAIL, longest // 2)
    return f"{spelt[: longest - tail]} ... {spelt[-tail:]}"


def printable(text: str) -> str:
    """Likewise for a text of several lines, at full length."""
    return _STEERING_BUT_LINES.sub(_spelt, text)


def joined(lines: Iterable[str]) -> str:
    """Lines under one another; a line break within one of them is escaped."""
    return "\n".join(_STEERING.sub(_spelt, line) for line in lines)


def command_line(*words: str) -> str:
    """A command to be typed; words with control characters are quoted as in `$'two\\nlines'`, which stays one line."""
    return " ".join(_ansi_quoted(word) if _STEERING.search(word) else shlex.quote(word) for word in words)


def reason(error: Exception) -> str:
    """What an error of a library says, in one line; its kind where it says nothing."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def count(number: int, noun: str) -> str:
    """A number with its noun: 1 scan, 2,000 scans."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def first_few(names: Sequence[object], most: int) -> str:
    """The first few of some names, and how many more there are: a, b and 3 more."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return f"{', '.join(map(str, names[:most]))}{more}"


def in_common(first: Sequence[str], second: Sequence[str]) -> int:
    """How many elements two sequences have in common at their beginnings."""
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(first, second, strict=False)))


def scan_span(first: int, last: int) -> str:
    """A stretch of scans by its first and last one: scan 3, scans 3 to 7."""
    return f"scan {first}" if first == last else f"scans {first} to {last}"


def as_typed(program: str) -> str:
    """The word that starts a program of this environment: its name where the shell finds it, else the path of its file.

    In a virtual environment that is not activated, such as that of `make demo`, the name alone is not found.
    """
    beside, here = Path(sys.executable).parent / program, Path.cwd()
    found = shutil.which(program)
    if not beside.is_file() or (found is not None and beside.samefile(found)):
        return program
    return f"./{beside.relative_to(here)}" if beside.is_relative_to(here) else str(beside)


def small_length(metres: float) -> str:
    """A length in the unit that suits it: 24 cm, 0.5 mm."""
    for factor, unit in ((1.0, "m"), (100.0, "cm")):
        if round(factor * metres, 6) >= 1.0:
            return f"{factor * metres:.3g} {unit}"
    return f"{1000.0 * metres:.2g} mm"


def up_to(metres: float) -> str:
    """The bound of a length: up to 24 cm, less than 0.1 mm."""
    return f"up to {small_length(metres)}" if metres >= 0.0001 else "less than 0.1 mm"


def _ansi_quoted(word: str) -> str:
    spelt = re.sub(r"[\\']", r"\\\g<0>", word)
    return f"$'{_STEERING.sub(_as_bytes, spelt)}'"


def _as_bytes(match: re.Match[str]) -> str:
    return "".join(f"\\x{byte:02x}" for byte in os.fsencode(match.group()))


def _spelt(match: re.Match[str]) -> str:
    return match.group().encode("unicode_escape").decode("ascii")


def require_name(name: str, what: str, reserved: Collection[str] = ()) -> str:
    """The name, if it is a safe component of a path: no separator, no control character, not hidden, not too long.

    Else a ConfigError, which says `what` has this name; `reserved` are names of other files in the same folder.
    """
    if safe_name(name) != name or name in reserved:
        raise ConfigError(f"{what} {name[:_LONGEST_NAME]!r}: cannot be the name of a folder; {_NAME_REMEDY}")
    return name


def safe_name(text: str) -> str:
    """A safe component of a path for something that has a name already, such as a topic or a sequence."""
    name = one_line(_SEPARATORS.sub("_", text)).replace("\\", "_").lstrip(".")
    name = name.encode()[:_LONGEST_NAME].decode(errors="ignore")
    return name if name.strip() else "recording"


def stays_below(path: str) -> bool:
    """Whether a relative path, with / between its parts, leads to no place outside the folder that it is joined to."""
    parts = PurePosixPath(path)
    return not parts.is_absolute() and ".." not in parts.parts
