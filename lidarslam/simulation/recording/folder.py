"""The folder of a simulated recording: whole or absent, and never in the place of anything else."""

import contextlib
import tempfile
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from lidarslam.core.errors import OutputError
from lidarslam.simulation.writers.registry import FORMATS

README = "README.md"
GROUND_TRUTH = "ground_truth.tum"  # where every reader of recordings without a layout of their own looks for it
REFERENCE_MAP = "map.ply"  # no digit in the name, or the reader of scan folders would take it for a scan
MADE_BY = "Made by `lidarslam simulate`"

_FILES = (README, GROUND_TRUTH, REFERENCE_MAP, *{name for row in FORMATS.values() for name in row.files})


@contextlib.contextmanager
def new_folder(out: Path, overwrite: bool = False) -> Iterator[Path]:
    """A path to make a folder at; it becomes `out` when the block ends without an error, else nothing is left of it.

    Its last part is that of `out`, as formats name files after their folder. With `overwrite` an earlier simulated
    recording is replaced, but nothing that holds other files too.

    Raises:
        OutputError: there is something already, or it cannot be written.
    """
    out = out.resolve()
    try:
        _refuse_to_replace(out, overwrite)
        out.parent.mkdir(parents=True, exist_ok=True)
        # Beside its final place, so that renaming is enough; hidden, so that a killed process leaves nothing to find.
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.partial-", dir=out.parent) as workplace:
            folder = Path(workplace) / out.name
            yield folder
            _refuse_to_replace(out, overwrite)
            if out.exists():
                out.rename(Path(workplace) / "earlier")
            folder.rename(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error})") from error


def _refuse_to_replace(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: a file is in the way; name another folder")
    names = sorted(entry.name for entry in out.iterdir()) if out.exists() else []
    if not names:
        return
    readme = out / README
    if not readme.is_file() or MADE_BY not in readme.read_text(encoding="utf-8", errors="replace"):
        raise OutputError(f"{out}: holds other files ({_listing(names)}); name another folder")
    if not overwrite:
        raise OutputError(f"{out}: holds a recording already; name another folder, or replace it with --overwrite")
    others = [name for name in names if not any(fnmatchcase(name, pattern) for pattern in _FILES)]
    if others:
        raise OutputError(f"{out}: holds more than a simulated recording ({_listing(others)}); move that away first")


def _listing(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
