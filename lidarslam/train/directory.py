"""The directory of a training: the names of its files, and whether an earlier one may be resumed or replaced."""

import shutil
from collections.abc import Iterable
from pathlib import Path

from lidarslam.config.settings import SOURCES_SECTION
from lidarslam.core.errors import OutputError

CONFIG = "config.yaml"
WEIGHTS = "weights.safetensors"
LAST_WEIGHTS = "weights_last.safetensors"
STATE = "state.safetensors"
LOSSES = "train.csv"
VALIDATION = "validation.csv"
CURVES = "tensorboard"
PREPARED = "prepared"

# Prepared recordings are no results: another training in the directory uses them again.
RESULTS = (CONFIG, WEIGHTS, LAST_WEIGHTS, STATE, LOSSES, VALIDATION, CURVES)


def earlier_training(path: Path, resume: bool, overwrite: bool) -> list[str]:
    """The files of a training in the directory, if it may be resumed or replaced.

    Raises:
        OutputError: it holds a training and neither is asked for, holds other files of these names, or there is none
            to resume.
    """
    present = [name for name in RESULTS if (path / name).exists()]
    listed = f"{', '.join(present[:3])}{', ...' if len(present) > 3 else ''}"
    if present and not is_training(path):
        raise OutputError(f"{path}: holds files that are not those of a training ({listed}); name another directory")
    if resume and not present:
        raise OutputError(f"{path}: holds no training to go on with; leave --resume out to begin one")
    if present and not resume and not overwrite:
        raise OutputError(
            f"{path}: holds a training already ({listed}); name another directory, go on with it by --resume,"
            " or replace it with --overwrite"
        )
    return present


def remove_results(path: Path, names: Iterable[str]) -> None:
    """Make room for another training; what is left by a kill can neither be resumed nor is it foreign."""
    for name in sorted(names, key=lambda name: (name == CONFIG, name != STATE)):
        if (path / name).is_dir() and not (path / name).is_symlink():
            shutil.rmtree(path / name)
        else:
            (path / name).unlink()


def is_training(path: Path) -> bool:
    """Whether the directory is of a training: the first section of its configuration names the recordings."""
    try:
        return (path / CONFIG).read_text(encoding="utf-8").startswith(f"{SOURCES_SECTION}:")
    except (OSError, UnicodeDecodeError):
        return False
