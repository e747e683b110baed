"""Lines of a text of unknown origin: never more of it in memory than a line, and no line without an end."""

from collections.abc import Iterator
from pathlib import Path

from lidarslam.core.errors import InputError

# Ten million poses and more, in a file and in a line.
_LONGEST_BYTES, _LONGEST_LINE = 1 << 30, 1 << 16
_MARK = b"\xef\xbb\xbf"  # of byte order


def bounded_lines(path: Path) -> Iterator[str]:
    """The lines of a file in UTF-8, without their ends.

    Raises:
        InputError: the file is missing, is not text, or it or a line is too long.
    """
    read = 0
    try:
        with path.open("rb") as file:
            while line := file.readline(_LONGEST_LINE + 1):
                if len(line) > _LONGEST_LINE:
                    raise InputError(f"{path}: cannot be read as text (a line has more than {_LONGEST_LINE:,} bytes)")
                line = line.removeprefix(_MARK) if read == 0 else line
                read += len(line)
                if read > _LONGEST_BYTES:
                    raise InputError(f"{path}: is longer than a gigabyte, which no text of a recording is")
                yield line.decode("utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from error
