"""Where a recording without a layout of its own keeps its true trajectory: in a TUM file of a customary name."""

from collections.abc import Sequence
from pathlib import Path

_NAMES = ("ground_truth.tum", "groundtruth.tum", "ground_truth.txt", "groundtruth.txt")


def find_truth_file(folders: Sequence[Path], stem: str | None = None) -> Path | None:
    """The true trajectory in the first folder that has one; `<stem>.tum` in any of them goes before general names."""
    own = [folder / f"{stem}.tum" for folder in folders] if stem else []
    general = [folder / name for folder in folders for name in _NAMES]
    return next((path for path in own + general if path.is_file()), None)
