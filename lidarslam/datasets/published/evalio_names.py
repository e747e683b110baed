"""Sources named as evalio names its data sets, `evalio:DATASET/SEQUENCE`, and the folders in which it keeps them."""

import os
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.datasets.published.catalogue import CATALOGUE

PREFIX = "evalio:"
MISSING_EXTRA = "evalio is not installed, which this data set needs; pip install 'lidarslam[datasets]'"

# As evalio 0.6.1 has them.
DATA_SETS = tuple(one.name for one in CATALOGUE if one.reader == "evalio")
# Published where no program can download.
_BY_HAND = ("botanic_garden",)
_LISTED = 6


def data_folder() -> Path:
    """Where evalio keeps its data: EVALIO_DATA, or evalio_data in the current folder."""
    return Path(os.environ.get("EVALIO_DATA", "evalio_data")).absolute()


def located(source: Path) -> Path:
    """The folder DATASET/SEQUENCE that a name stands for; other sources as they are."""
    name = str(source)
    return data_folder() / name.removeprefix(PREFIX) if name.startswith(PREFIX) else source


def is_of_evalio(source: Path) -> bool:
    """Whether a path reads DATASET/SEQUENCE as evalio lays out its data; data sets of others need EVALIO_CUSTOM."""
    data_set = source.absolute().parent.name
    return data_set in DATA_SETS or (bool(os.environ.get("EVALIO_CUSTOM")) and data_set in sequences())


def resolved(source: Path) -> Path:
    """The absolute path; links are resolved, but for one that would hide DATASET/SEQUENCE."""
    path = source.resolve()
    return source.absolute() if is_of_evalio(source) and not is_of_evalio(path) else path


def full_name(source: Path) -> str:
    """DATASET/SEQUENCE of a folder."""
    return f"{source.absolute().parent.name}/{source.name}"


def sequences() -> dict[str, tuple[str, ...]]:
    """The sequences of each data set that evalio knows, those of EVALIO_CUSTOM too; none where it is not installed."""
    try:
        from evalio import datasets
    except ImportError:
        return {}
    known = datasets.all_datasets()
    return {name: tuple(one.seq_name for one in known[name].sequences()) for name in sorted(known)}


def how_to_get(source: Path) -> str:
    """The command that downloads a sequence to where it is looked for."""
    if source.absolute().parent.name in _BY_HAND:
        return f"its page has the files, for {source.absolute()}"
    root = source.absolute().parent.parent
    place = "" if os.environ.get("EVALIO_DATA") and root == data_folder() else f"-D {root} "
    return f"evalio {place}dl {full_name(source)}"


def absent(source: Path) -> str | None:
    """Why a folder of evalio's is not there and how to get it; None of any other path."""
    folder = source.absolute()
    if not (folder.is_relative_to(data_folder()) or is_of_evalio(folder) or folder.name in DATA_SETS):
        return None
    known = sequences()
    if folder.name in {*DATA_SETS, *known}:
        return f"{source}: is a data set of evalio; name one of its sequences{_choice(folder.name, known)}"
    data_set = folder.parent.name
    if known and data_set not in known:
        return f"{source}: evalio has no data set {data_set}; there are: {', '.join(known)}"
    if known and source.name not in known[data_set]:
        return f"{source}: evalio has no {full_name(source)}; there are{_choice(data_set, known)}"
    install = "" if known else "; evalio comes with pip install 'lidarslam[datasets]'"
    return f"{source}: is not downloaded: {how_to_get(source)}{install}"


def require_known(source: Path) -> None:
    """Check that evalio has the sequence.

    Raises:
        InputError: evalio is not installed, or has no such sequence.
    """
    known = sequences()
    if not known:
        raise InputError(f"{source}: {MISSING_EXTRA}")
    data_set = source.absolute().parent.name
    if source.name not in known.get(data_set, ()):
        raise InputError(
            f"{source}: evalio has no {full_name(source)}{_choice(data_set, known)}; a folder of another data set is"
            " read with --reader"
        )


def _choice(data_set: str, known: dict[str, tuple[str, ...]]) -> str:
    names = [f"{PREFIX}{data_set}/{name}" for name in known.get(data_set, ())]
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f": {', '.join(names[:_LISTED])}{more}" if names else ""
