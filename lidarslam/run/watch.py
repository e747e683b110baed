"""What a run does with every scan that is done: log it, show it, time it, and end where the scans end."""

import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.pipeline import Pipeline, ScanResult
from lidarslam.pipeline.prefetch import prefetch
from lidarslam.run.scan_log import ScanLog
from lidarslam.viewer.viewer import Viewer
from mapping.global_map.global_map import GlobalMap

Progress = Callable[[int, int, ScanResult], None]
"""Called after every scan with its number from 1, how many there are, and what became of it."""


@dataclass
class Watch:
    """Everyone who is told of each scan, and the wall time each took, milliseconds."""

    log: ScanLog
    viewer: Viewer
    truth: Trajectory | None
    progress: Callable[[int, ScanResult], None]
    total_ms: list[float] = field(default_factory=list)
    _is_truth_shown: bool = False

    def see(self, result: ScanResult, global_map: GlobalMap | None) -> None:
        """One more scan is done."""
        index = len(self.log)
        self.log.add(result)
        if not self._is_truth_shown:
            _show_reference(self.viewer, self.truth, self.log.stamps[0])
            self._is_truth_shown = True
        self.viewer.show_scan(index, result)
        if global_map is not None and self.viewer.wants_map(index):
            self.viewer.show_map(global_map.points())
        self.progress(index + 1, result)


def process(pipeline: Pipeline, scans: Iterable[Scan], watch: Watch) -> InputError | KeyboardInterrupt | None:
    """Take every scan through the pipeline; what ended it early, None when nothing did."""
    finished = time.perf_counter()
    try:
        with closing(pipeline.run(prefetch(scans))) as results:
            for result in results:
                watch.see(result, pipeline.global_map)
                last, finished = finished, time.perf_counter()
                watch.total_ms.append(1e3 * (finished - last))
    except (InputError, KeyboardInterrupt) as error:
        watch.log.warn(f"stopped after {len(watch.log)} scans: {reason(error)}")
        # A scan may have been logged whose time was not.
        watch.total_ms.extend([0.0] * (len(watch.log) - len(watch.total_ms)))
        return error
    return None


def reason(error: InputError | KeyboardInterrupt) -> str:
    """Why the scans ended early, in words."""
    return str(error) or "interrupted"


def _show_reference(viewer: Viewer, ground_truth: Trajectory | None, first_stamp: float) -> None:
    """Show the truth in the run's world: where both have the first scan, they coincide."""
    if ground_truth is None or len(ground_truth) < 2:
        return
    nearest = np.clip(first_stamp, ground_truth.stamps[0], ground_truth.stamps[-1])
    T_truth_first = ground_truth.at(np.array([nearest]))[0]
    viewer.show_reference(ground_truth.transformed(inverse(T_truth_first)))
