"""Multi-session map merging on disk: each recording becomes a run, all that loop closures connect one map."""

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from lidarslam.config.settings import dump_yaml
from lidarslam.core.errors import InputError
from lidarslam.datasets.published.evalio_names import resolved
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.global_map.moved_points import PlacedViews
from lidarslam.mapping.pose_graph.g2o import format_g2o
from lidarslam.run.loop_closing import FinishedGraph, begin_graph
from lidarslam.run.modes.merge.parts import MergeRequest, closing_loops, earlier_parts, open_parts, remove_part
from lidarslam.run.modes.merge.summary import MergedRecording, MergeSummary
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.run.results import RunOutcome, draw, final_map, write_map, write_results
from lidarslam.run.run import open_odometry
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.summary.summary import GraphSummary, peak_rss_mb
from lidarslam.run.summary.written_map import WrittenMap
from lidarslam.run.tracking import NoScanError, Progress, Tracked, track
from lidarslam.storage import directory as files
from lidarslam.storage.directory import RunDirectory
from lidarslam.storage.unfinished import Unfinished
from lidarslam.viewer.viewer import Viewer

if TYPE_CHECKING:
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

# In the summary of a run; that of the merge says how to mend it.
_OF_ITS_OWN = "its poses are in a frame of its own: nothing joins it to the other recordings"

Show = Callable[[str], AbstractContextManager[Progress]]
"""Opens the progress of a recording, given its name."""


@dataclass(frozen=True)
class MergeOutcome:
    """A merge that was written."""

    summary: MergeSummary  # in numbers
    runs: tuple[RunOutcome | None, ...]  # of each recording; None where none of its scans could be used
    stopped: tuple[str, ...]  # which recordings ended before their last scan, and why, a line each

    @property
    def apart(self) -> tuple[MergedRecording, ...]:
        """The recordings that are not in the common map."""
        return tuple(recording for recording in self.summary.recordings if not recording.joined)


@dataclass(eq=False)
class _Part:
    """A recording with its run directory; once tracked, either its scans or why it has none."""

    request: RunRequest
    recording: Recording
    directory: RunDirectory
    tracked: Tracked | None = None
    missing: str = ""

    @property
    def scans(self) -> int:
        return 0 if self.tracked is None else len(self.tracked.log)

    def on_voxels(self, voxel_size_m: float) -> None:
        """One map has one voxel size."""
        global_map = self.request.config.global_map.model_copy(update={"voxel_size_m": voxel_size_m})
        config = self.request.config.model_copy(update={"global_map": global_map})
        self.request = replace(self.request, config=config)


def merge(request: MergeRequest, show: Show) -> MergeOutcome:
    """Run every recording, find the later ones in the earlier ones, and write the map of all.

    A recording that turns out damaged on the way ends there and the next goes on; an interruption ends everything with
    what there is. A recording that no loop joins to the others has a run of its own and is left out of the common map.

    Raises:
        LidarSlamError: a source, the configuration or the output directory is not usable.
    """
    started = time.perf_counter()
    request = replace(request, config=closing_loops(request.config))
    runs, earlier = open_parts(request), earlier_parts(request.out)
    names = {run.out.name for run, _ in runs}
    with ExitStack() as stack:
        directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite))
        unfinished = [_begin(directory, request.describe() | {"merge": "all", "parts": sorted(names)}, stack)]
        parts = []
        for run, recording in runs:
            if run.out.is_symlink():
                run.out.unlink()
            own = stack.enter_context(RunDirectory.create(run.out, request.overwrite))
            parts.append(_Part(run, recording, own))
            unfinished.append(_begin(own, request.describe() | {"merge": "part"}, stack))
        graph = begin_graph(request.config, request.out)
        assert graph is not None
        stack.callback(graph.close)
        _track_all(parts, graph, show)
        if not any(part.tracked for part in parts):
            raise InputError(f"no scan of any recording could be used: {'; '.join(_missing(parts))}")
        outcome = _write(request, directory, parts, graph, started)
        for name in earlier - names:
            remove_part(request.out / name)
    for mark in reversed(unfinished):
        mark.end(stopped=False)
    for part, written in zip(parts, outcome.runs, strict=True):
        if written is None:
            with suppress(OSError):  # something else lies there
                part.request.out.rmdir()
    return outcome


def _begin(directory: RunDirectory, description: dict[str, Any], stack: ExitStack) -> Unfinished:
    """Mark a directory as unfinished."""
    unfinished = stack.enter_context(Unfinished.claim(directory, description, resume=False))
    unfinished.begin(0)
    return unfinished


def _missing(parts: Sequence[_Part]) -> list[str]:
    return [part.missing for part in parts if part.missing]


def _track_all(parts: Sequence[_Part], graph: "SlamGraph", show: Show) -> None:
    """Run one recording after the other, until all are done or an interruption."""
    for number, part in enumerate(parts, start=1):
        if number > 1:
            graph.begin_recording()
        try:
            with (
                show(f"{number}/{len(parts)} {part.recording.name}") as progress,
                closing(open_odometry(part.request.config, None)) as odometry,
            ):
                scans = range(len(part.recording))
                tracked = track(part.request, part.recording, scans, odometry, ScanLog(), graph, Viewer(), progress)
        except (NoScanError, KeyboardInterrupt) as error:
            of_user = isinstance(error, KeyboardInterrupt)
            part.missing = f"{part.request.source}: interrupted" if of_user else str(error)
            interrupted = isinstance(error, KeyboardInterrupt) or error.interrupted
        else:
            if tracked.global_map is not None:
                for one in parts:
                    one.on_voxels(tracked.global_map.voxel_size_m)
            # The map is drawn anew from the graph.
            part.tracked = replace(tracked, global_map=None)
            interrupted = isinstance(tracked.error, KeyboardInterrupt)
        if interrupted:
            for left in parts[number:]:
                left.missing = f"{left.request.source}: not begun"
            return


def _write(
    request: MergeRequest, directory: RunDirectory, parts: Sequence[_Part], graph: "SlamGraph", started: float
) -> MergeOutcome:
    """Optimise the graph, and write the runs and the common map."""
    voxel_size_m = parts[0].request.config.global_map.voxel_size_m
    scans = [part.scans for part in parts]
    finished = (
        None
        if voxel_size_m is None
        else FinishedGraph.of_recordings(graph, scans, voxel_size_m, request.config.global_map.most_points)
    )
    joined = [] if finished is None else finished.joined
    runs = tuple(_write_run(part, finished, index, index in joined) for index, part in enumerate(parts))
    common = None if finished is None else finished.common()
    # First, because it says whose files the others are.
    directory.write_text(files.CONFIG, dump_yaml(request.config, request.describe()))
    written = WrittenMap(0, voxel_size_m, 0)
    if common is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(common.keyframe_poses, common.edges))
        views, begin = [], 0
        for part in (parts[index] for index in joined):
            if part.tracked is not None:
                views.append(part.tracked.views.placed(common.T_world_lidar[begin : begin + part.scans]))
            begin += part.scans
        drawn = draw(common.global_map, PlacedViews.join(views), request.config.global_map, directory)
        written = write_map(directory, drawn, request.map_formats)
    recordings = tuple(_entry(part, runs[index], index in joined) for index, part in enumerate(parts))
    summary = MergeSummary(
        recordings=recordings,
        elapsed_s=time.perf_counter() - started,
        peak_rss_mb=peak_rss_mb(),
        graph=None if common is None else GraphSummary.of(common),
        map=written,
        warnings=(*_warnings(recordings, runs), *_missing(parts), *filter(None, [drawn.warning])),
    )
    directory.write_json(files.SUMMARY, summary.to_json())
    stopped = [
        f"{part.request.source}: stopped after {run.summary.scans} scans: {run.stopped}"
        for part, run in zip(parts, runs, strict=True)
        if run is not None and run.stopped is not None
    ]
    return MergeOutcome(summary, runs, (*stopped, *_missing(parts)))


def _write_run(part: _Part, finished: FinishedGraph | None, index: int, is_joined: bool) -> RunOutcome | None:
    """The run of one recording, its poses as the graph corrected them."""
    if part.tracked is None:
        return None
    closed = None if finished is None else finished.outcome([index])
    if closed is not None:
        part.tracked.log.correct(closed.T_world_lidar)
    if not is_joined:
        part.tracked.log.warn(_OF_ITS_OWN)
    drawn = final_map(part.tracked, closed, part.request.config.global_map, part.directory)
    request = part.request
    return write_results(
        part.directory, request.config, describe_run(request), part.tracked, closed, drawn, request.map_formats
    )


def _entry(part: _Part, run: RunOutcome | None, is_joined: bool) -> MergedRecording:
    return MergedRecording(
        name=part.recording.name,
        directory=None if run is None else part.request.out.name,
        source=str(resolved(part.request.source)),
        scans=part.scans,
        length_m=0.0 if run is None else run.summary.length_m,
        lost_scans=0 if run is None else run.summary.lost_scans,
        joined=is_joined,
    )


def _warnings(recordings: Sequence[MergedRecording], runs: Sequence[RunOutcome | None]) -> list[str]:
    """Recordings that are not in the common map, and the warnings of runs."""
    apart = [
        f"{entry.directory}: left out of the common map, because no loop closure with the others was accepted."
        f" Give recordings that share more of the way; the loops in {files.SUMMARY} say why each was rejected"
        for entry in recordings
        if not entry.joined and entry.directory is not None
    ]
    own = [
        f"{entry.directory}: {warning}"
        for entry, run in zip(recordings, runs, strict=True)
        if run is not None
        for warning in run.summary.warnings
        if warning != _OF_ITS_OWN
    ]
    return [*apart, *own]
