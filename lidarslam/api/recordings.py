"""Recordings on disk as sequences of scans, and the evaluation of trajectories and maps."""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

from lidarslam.assessment.evaluate import EvaluateRequest
from lidarslam.assessment.evaluate import evaluate as evaluate_request
from lidarslam.config.settings import make_config
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.fetched import fetched
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.alignment import AlignmentMethod

Source = str | PathLike[str] | Trajectory


class OpenRecording:
    """A recording on disk; iterating reads one scan after the other, in the order of time, as a run does."""

    def __init__(self, recording: Recording, chosen: range) -> None:
        self._recording = recording
        self._chosen = chosen
        self._faults = Faults()

    def __len__(self) -> int:
        """Number of scans; iterating leaves out those that cannot be read."""
        return len(self._chosen)

    def __iter__(self) -> Iterator[Scan]:
        """The scans; InputError at damage for which no scan can be left out."""
        self._faults = Faults()
        return take_in(self._recording, self._chosen, self._faults)

    @property
    def name(self) -> str:
        """A short name."""
        return self._recording.name

    @property
    def ground_truth(self) -> Trajectory | None:
        """The true poses of the LiDAR, at stamps and in a world of their own; None where the recording has none.

        Raises:
            InputError: they are damaged.
        """
        return self._recording.ground_truth

    @property
    def warnings(self) -> tuple[str, ...]:
        """Faults of the recording as a whole, and of the scans that were read by the latest iteration."""
        return (*self._recording.warnings, *self._faults.warnings())


def open(
    source: str | PathLike[str],
    *,
    topic: str | None = None,
    sequence: str | None = None,
    reader: str | None = None,
    start: int = 0,
    stop: int | None = None,
    step: int = 1,
) -> OpenRecording:
    """Open a recording: anything that `lidarslam run` takes.

    Args:
        source: a bag, a folder of scans, a data set's folder, evalio:DATASET/SEQUENCE, or the URL of one of these.
        topic: point cloud topic of a bag that has several.
        sequence: sequence of a KITTI odometry root, such as "04".
        reader: name of the reader; None: the one that recognises the source.
        start, stop, step: which scans, as in `range`.

    Raises:
        InputError: the source cannot be read.
    """
    given = {"topic": topic, "sequence": sequence, "name": reader}
    config = make_config({"reader": {key: value for key, value in given.items() if value is not None}})
    recording = open_recording(fetched(source), config.reader)
    return OpenRecording(recording, range(len(recording))[start:stop:step])


def evaluate(
    estimate: Source,
    reference: Source | None = None,
    *,
    reference_map: str | PathLike[str] | None = None,
    alignment: AlignmentMethod = "se3",
) -> dict[str, Any]:
    """The errors of a trajectory, and of its map where there is a reference for it: the content of metrics.json.

    Nothing is written. Errors that cannot be computed are None.

    Args:
        estimate: a trajectory; the path of one in TUM or KITTI text; or a run directory.
        reference: likewise, or the path of a recording with ground truth; None: the ground truth that came with the
            recording of the run.
        reference_map: the path of a point cloud to compare the map with.
        alignment: of the trajectory, for the absolute errors.

    Raises:
        InputError: a file is missing or damaged, there is no reference, or the two have no instant in common.
    """
    request = EvaluateRequest(
        estimate if isinstance(estimate, Trajectory) else Path(estimate),
        reference if reference is None or isinstance(reference, Trajectory) else Path(reference),
        None if reference_map is None else Path(reference_map),
        alignment=alignment,
        write=False,
    )
    return evaluate_request(request).to_json()
