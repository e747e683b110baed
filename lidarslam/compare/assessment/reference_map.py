"""Reference maps: a file, or the exact map beside a simulated recording."""

from dataclasses import dataclass
from pathlib import Path

from lidarslam.compare.assessment.reference_cloud import read_cloud
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.simulation.record import GROUND_TRUTH, MADE_BY, README, REFERENCE_MAP


@dataclass(frozen=True, eq=False)
class ReferenceMap:
    """A map to compare with."""

    path: Path  # of its file
    points: FloatArray  # (N, 3) in its own frame
    truth: Trajectory | None = None  # the true trajectory in that frame; None when none is known

    @property
    def label(self) -> str:
        """For messages."""
        return f"{self.path}{'' if self.truth is None else ', the exact map of the simulation'}"


def load_reference_map(path: Path) -> ReferenceMap:
    """A map from a file; that of a simulated recording brings its trajectory with it.

    Raises:
        InputError: the file cannot be read.
    """
    truth = path.parent / GROUND_TRUTH
    is_simulated = path.name == REFERENCE_MAP and _is_simulated(path.parent) and truth.is_file()
    return ReferenceMap(path, read_cloud(path), read_tum(truth) if is_simulated else None)


def find_reference_map(source: Path) -> ReferenceMap | None:
    """The exact map of a simulated recording, which lies in its folder; None of any other.

    Raises:
        InputError: it cannot be read.
    """
    # Of a recording in KITTI's layout, the source may be sequences/NN.
    for folder in [source, *source.resolve().parents[:2]]:
        if (folder / REFERENCE_MAP).is_file() and _is_simulated(folder):
            return load_reference_map(folder / REFERENCE_MAP)
    return None


def _is_simulated(folder: Path) -> bool:
    readme = folder / README
    return readme.is_file() and MADE_BY in readme.read_text(encoding="utf-8", errors="replace")
