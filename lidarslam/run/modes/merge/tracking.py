"""The recordings of a merge as tasks: each is tracked by itself, and leaves its result in its run directory."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.core.errors import OutputError
from lidarslam.core.files import only_writer
from lidarslam.datasets.published.fetched import fetch
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import begin_graph
from lidarslam.run.modes.merge.tracked_part import TrackedPart, read_part
from lidarslam.run.request import RunRequest
from lidarslam.run.resuming import describe_computed
from lidarslam.run.run import open_odometry
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.tracking import NoScanError, Progress, track
from lidarslam.storage.about import About
from lidarslam.storage.checkpoint_files import CheckpointFiles
from lidarslam.storage.directory import RunDirectory, files_in
from lidarslam.storage.state_file import read_state
from lidarslam.storage.unfinished import Unfinished
from lidarslam.viewer.viewer import Viewer

# A process whose node was lost may be at work for some seconds more.
_PATIENCE_S = 60.0

Show = Callable[[str], AbstractContextManager[Progress]]
"""Opens the progress of a recording, given its name."""


@dataclass(frozen=True)
class PartTask:
    """The tracking of one recording."""

    request: RunRequest
    name: str  # for the progress
    merge: dict[str, Any]  # which merge it is a part of
    folder: str  # that relative paths are relative to
    url: str | None  # of the source, where it was fetched


@dataclass(frozen=True)
class PartDone:
    """A recording after its task."""

    scans: int  # that were tracked
    missing: str = ""  # why there is none
    interrupted: bool = False  # whether there would be more


@contextlib.contextmanager
def _unseen(_name: str) -> Iterator[Progress]:
    yield lambda _number, _total, _result: None


def track_part(task: PartTask, show: Show = _unseen) -> PartDone:
    """Track a recording, from its last checkpoint where there is one; nothing is done where it was tracked before.

    Raises:
        LidarSlamError: the recording, the configuration or the directory is not usable, or the directory of the merge
            is not that of another machine.
    """
    out = task.request.out
    with ExitStack() as stack:
        with contextlib.suppress(OSError):  # a machine without that folder has no file there either
            stack.enter_context(contextlib.chdir(task.folder))
        if task.url is not None:
            fetch(task.url, task.request.source)
        if About.read(out.parent) is None:
            raise OutputError(
                f"{out.parent}: is not shared by the nodes of the cluster; name a folder that is with --out"
            )
        interruptions = stack.enter_context(Interruptions())
        recording = open_recording(task.request.source, task.request.config.reader)
        files = CheckpointFiles(out)
        files.require_own()
        files.make_folder()
        stack.enter_context(only_writer(files.folder, _PATIENCE_S))
        description = describe_computed(task.request, recording) | task.merge
        is_begun = About.read(out) is not None
        unfinished = stack.enter_context(Unfinished.claim(RunDirectory(out, files_in(out)), description, is_begun))
        if unfinished.files.tracked.is_file():
            earlier = read_part(read_state(unfinished.files.tracked))
            if not earlier.interrupted:
                return PartDone(len(earlier.log))
        with show(task.name) as progress:
            return _track(task.request, recording, unfinished, progress, interruptions)


def _track(
    request: RunRequest,
    recording: Recording,
    unfinished: Unfinished,
    progress: Progress,
    interruptions: Interruptions,
) -> PartDone:
    """Track a recording, and leave the result."""
    graph, scans, log = _open_graph(request.config, unfinished), range(len(recording)), ScanLog()
    with closing(graph), closing(open_odometry(request.config, None)) as odometry:
        try:
            tracked = track(request, recording, scans, odometry, log, graph, Viewer(), progress, unfinished)
        except NoScanError as error:
            unfinished.end(stopped=False)
            return PartDone(0, f"{request.source}: interrupted" if error.interrupted else str(error), error.interrupted)
        interruptions.protect_results()
        graph.end_recording()
        part = TrackedPart.of(tracked)
        part.write(unfinished, graph)
    if not part.interrupted:
        unfinished.remove_checkpoint()
    return PartDone(len(part.log), interrupted=part.interrupted)


def _open_graph(config: Config, unfinished: Unfinished) -> KeyframeGraph:
    """The graph of one recording, new or as it was saved; with loop closures only where they correct the local map."""
    graph: KeyframeGraph | None = None
    if config.mapping.method == "surfels" and config.pose_graph.corrects_local_map:
        graph = begin_graph(config, file=unfinished.files.submaps)
    graph = graph or KeyframeGraph(config.pose_graph.keyframes, file=unfinished.files.submaps)
    if unfinished.saved is not None:
        graph.restore(unfinished.saved.part("graph"))
    return graph
