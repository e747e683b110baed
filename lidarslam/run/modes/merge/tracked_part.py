"""A tracked recording of a merge on disk, from which its task, and the merge when it is resumed, go on."""

from dataclasses import dataclass
from pathlib import Path

from lidarslam.config.settings import Config
from lidarslam.core.state.stateful import Saved, decode
from lidarslam.core.state.tree import encode
from lidarslam.datasets.faults import Faults
from lidarslam.mapping.global_map.moved_points import Views
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.mapping.slides.slides import PairTests
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.tracking import Tracked
from lidarslam.storage.state_file import write_state
from lidarslam.storage.unfinished import Unfinished


@dataclass(frozen=True, eq=False)
class TrackedPart:
    """What `Tracked` holds of a recording, but what is read from it again or drawn anew."""

    log: ScanLog
    asked: int
    faults: Faults
    views: Views
    slides: PairTests
    stopped: str | None  # why it ended before its last scan
    interrupted: bool  # whether that was an interruption

    @classmethod
    def of(cls, tracked: Tracked) -> "TrackedPart":
        """A recording that was just tracked."""
        interrupted = isinstance(tracked.error, KeyboardInterrupt)
        log, slides = tracked.log, tracked.slides
        return cls(log, tracked.asked, tracked.faults, tracked.views, slides, tracked.stopped, interrupted)

    def write(self, unfinished: Unfinished, graph: KeyframeGraph) -> None:
        """Leave it, and its graph, whose submaps are there already.

        Raises:
            OutputError: it cannot be written.
        """
        write_state(unfinished.files.tracked, {"part": encode(TrackedPart, self), "graph": graph.state()})


def read_part(saved: Saved) -> TrackedPart:
    """The recording of a file; InputError where it is damaged."""
    part: TrackedPart = decode(TrackedPart, saved.value("part"), saved.at("part"))
    return part


def read_graph(saved: Saved, config: Config, submaps: Path) -> KeyframeGraph:
    """Its graph; InputError where a file is damaged."""
    graph = KeyframeGraph(config.pose_graph.keyframes, file=submaps)
    graph.restore(saved.part("graph"))
    return graph
