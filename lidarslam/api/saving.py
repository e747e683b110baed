"""A run directory of scans that were registered one by one."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from lidarslam.config.settings import Config
from lidarslam.core.errors import LidarSlamError
from lidarslam.datasets.faults import Faults
from lidarslam.mapping.global_map.drawing import DrawnMap
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.run.loop_closing import GraphOutcome, loops_so_far
from lidarslam.run.results import final_map, write_results
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.tracking import Tracked
from lidarslam.storage.directory import RunDirectory

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

_OPTION = re.compile(r"--([a-z][a-z-]*)")


@dataclass(frozen=True, eq=False)
class Built:
    """All that was built of the scans so far."""

    config: Config  # of the computation
    # log, faults: of the scans; changed by `correct`
    log: ScanLog
    faults: Faults
    map: MapBuilder  # the global map, and what is kept beside it
    graph: "SlamGraph | None"  # the pose graph

    def correct(self, directory: RunDirectory | None = None) -> tuple[GraphOutcome | None, DrawnMap]:
        """Correct the log by the loops that are closed, and draw the map, with tiles in the directory."""
        closed = loops_so_far(self.graph, self.map.global_map, self.log)
        return closed, final_map(self.tracked(), closed, self.config.global_map, directory)

    def tracked(self) -> Tracked:
        """The same as a recording after the pipeline."""
        built = self.map
        return Tracked(
            None,
            None,
            self.log,
            len(self.log),
            self.faults,
            built.global_map,
            built.views,
            built.slides.tests,
            None,
        )


def save_run(path: Path, overwrite: bool, config: Config, built: Built) -> None:
    """Write a run directory.

    Raises:
        OutputError: the directory holds something else, or cannot be written.
    """
    described = {"version": version("lidarslam"), "source": None}
    with python_names(), RunDirectory.create(path, overwrite) as directory:
        closed, drawn = built.correct(directory)
        write_results(directory, config, described, built.tracked(), closed, drawn)


@contextmanager
def python_names() -> Iterator[None]:
    """Messages name the options of commands; those of functions have the same names, without dashes."""
    try:
        yield
    except LidarSlamError as error:
        error.args = (_OPTION.sub(lambda found: found[1].replace("-", "_"), str(error)), *error.args[1:])
        raise
