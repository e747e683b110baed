"""Several recordings of one place on disk: each becomes a run, and all that find one another become one map."""

import json
import re
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarslam.config.settings import Config, dump_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.merge.summary import MergedRecording, MergeSummary
from lidarslam.pipeline.loop_closing import FinishedGraph, GraphOutcome, begin_graph
from lidarslam.resume.unfinished import About, Unfinished, remove_unfinished
from lidarslam.run import directory as files
from lidarslam.run.directory import RunDirectory, remove_run
from lidarslam.run.request import RunRequest
from lidarslam.run.results import RunOutcome, drawn_map, final_map, write_map, write_results
from lidarslam.run.run import open_odometry, require_apart
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.summary import GraphSummary, WrittenMap, peak_rss_mb
from lidarslam.run.tracking import NoScanError, Progress, Tracked, track
from lidarslam.viewer.viewer import Viewer
from mapping.global_map.moved_points import PlacedViews
from mapping.pose_graph.g2o import format_g2o

if TYPE_CHECKING:
    from mapping.pose_graph.slam_graph import SlamGraph

# The directories of recordings, see `_runs`; whatever else a summary names is not ours to remove.
_PART = re.compile(r"\d{2,}_[\w.-]+")
# Of a run; the merge says the same with a way out.
_OF_ITS_OWN = "its poses are in a frame of its own: nothing joins it to the other recordings"

Show = Callable[[str], AbstractContextManager[Progress]]
"""Given the name of a recording that is about to begin, whom to tell of its scans."""


@dataclass(frozen=True)
class MergeRequest:
    """What is to be merged, how, and where it goes.

    Attributes:
        sources: two recordings or more, each once; the first that others find themselves in gives the frame.
        out: the directory of the merged map.
        config: how it is computed; loops are closed whatever it says.
        pcd: whether the maps are written as .pcd too.
        overwrite: whether an earlier merge, or a run, in `out` is replaced.
    """

    sources: tuple[Path, ...]
    out: Path
    config: Config
    pcd: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class MergeOutcome:
    """What a merge came to.

    Attributes:
        summary: in numbers.
        runs: of each recording; None where none of its scans could be used.
        stopped: which recordings ended before their last scan, and why, a line each.
    """

    summary: MergeSummary
    runs: tuple[RunOutcome | None, ...]
    stopped: tuple[str, ...]

    @property
    def apart(self) -> tuple[MergedRecording, ...]:
        """The recordings that are not in the common map."""
        return tuple(recording for recording in self.summary.recordings if not recording.joined)


@dataclass(frozen=True, eq=False)
class _Part:
    """One of the recordings: what it is asked for, and where its run goes."""

    request: RunRequest
    recording: Recording
    directory: RunDirectory

    @property
    def name(self) -> str:
        return self.request.out.name


@dataclass(eq=False)
class _Way:
    """What has become of the recordings so far; those begun come first, None for one without a usable scan."""

    tracked: list[Tracked | None] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # why those have no scan that have none
    voxel_size_m: float | None = None
    interrupted: bool = False


def merge(request: MergeRequest, show: Show) -> MergeOutcome:
    """Run every recording, find the later ones in the earlier ones, and write the map of all.

    A recording that turns out damaged on the way ends there and the next goes on; an interruption ends everything with
    what there is. What no loop joins to the others has a run of its own and is left out of the common map.

    Raises:
        LidarSlamError: a source, the configuration or the output directory is not usable.
    """
    started = time.perf_counter()
    request = replace(request, config=_closing_loops(request.config))
    recordings = _open(request)
    runs = _runs(request, recordings)
    _require_free(request)
    earlier = _earlier_parts(request.out)
    with ExitStack() as stack:
        directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite))
        described = _describe(request)
        names = [run.out.name for run in runs]
        unfinished = [_begin(directory, described | {"merge": "all", "parts": names}, stack)]
        parts = []
        for run, recording in zip(runs, recordings, strict=True):
            own = stack.enter_context(RunDirectory.create(run.out, request.overwrite))
            parts.append(_Part(run, recording, own))
            unfinished.append(_begin(own, described | {"merge": "part"}, stack))
        graph = begin_graph(request.config, request.out)
        assert graph is not None
        stack.callback(graph.close)
        way = _track_all(parts, graph, show)
        if not any(way.tracked):
            raise InputError(f"no scan of any recording could be used: {'; '.join(way.missing)}")
        outcome = _write(request, directory, parts, way, graph, started)
        for name in earlier - {part.name for part in parts}:
            _remove_part(request.out / name)
    for mark in reversed(unfinished):
        mark.end(stopped=False)
    for run, written in zip(runs, outcome.runs, strict=True):
        if written is None:
            with suppress(OSError):  # something else lies there
                run.out.rmdir()
    return outcome


def _begin(directory: RunDirectory, description: dict[str, Any], stack: ExitStack) -> Unfinished:
    """Say of a directory that what lies there is not whole, until it is."""
    unfinished = stack.enter_context(Unfinished.claim(directory, description, resume=False))
    unfinished.begin(0)
    return unfinished


def _describe(request: MergeRequest) -> dict[str, Any]:
    """What is merged, for config.yaml and for whoever finds it unfinished."""
    return {"version": version("lidarslam"), "sources": [str(source.resolve()) for source in request.sources]}


def _closing_loops(config: Config) -> Config:
    if config.odometry.method == "external":
        raise ConfigError(
            "odometry.method is external: one trajectory is not that of several recordings; choose another"
        )
    return config.model_copy(update={"pose_graph": config.pose_graph.model_copy(update={"enabled": True})})


def _open(request: MergeRequest) -> list[Recording]:
    """All recordings, so that one that cannot be read is told before the first is run."""
    if len(request.sources) < 2:
        raise InputError("expected two recordings or more; for the map of a single one use lidarslam run")
    seen: set[Path] = set()
    recordings = []
    for source in request.sources:
        if source.resolve() in seen:
            raise InputError(f"{source}: is named twice; name every recording once")
        seen.add(source.resolve())
        require_apart(request.out, source)
        recording = open_recording(source, request.config.reader)
        if not len(recording):
            raise InputError(f"{source}: holds no scan; leave it out")
        recordings.append(recording)
    return recordings


def _runs(request: MergeRequest, recordings: Sequence[Recording]) -> list[RunRequest]:
    """What is asked for of each; directories count from 1 and take the recordings' names, as file names allow."""
    requests = []
    for number, (source, recording) in enumerate(zip(request.sources, recordings, strict=True), start=1):
        name = re.sub(r"[^\w.-]+", "_", recording.name).strip("._")
        out = request.out / f"{number:02d}_{name or 'recording'}"
        require_apart(out, source)
        requests.append(RunRequest(source, out, request.config, pcd=request.pcd, overwrite=request.overwrite))
    return requests


def _require_free(request: MergeRequest) -> None:
    """See that no merge lies there unfinished, unless it is to be replaced."""
    about = None if request.overwrite else About.read(request.out)
    if about is not None:
        raise OutputError(f"{request.out}: {about.remedy(request.out)}")


def _earlier_parts(out: Path) -> set[str]:
    """The directories of an earlier merge's recordings, be it unfinished."""
    names: list[Any] = []
    with suppress(OSError, ValueError, KeyError, TypeError):
        entries = json.loads((out / files.SUMMARY).read_text(encoding="utf-8"))["recordings"]
        names += [entry["directory"] for entry in entries]
    with suppress(InputError, KeyError, TypeError):
        about = About.read(out)
        names += [] if about is None else about.description["parts"]
    return {name for name in names if isinstance(name, str) and _PART.fullmatch(name)}


def _remove_part(path: Path) -> None:
    """Remove the run of a recording that is no longer merged."""
    if (path / files.ABOUT).exists():
        remove_unfinished(path)
    else:
        remove_run(path)


def _track_all(parts: Sequence[_Part], graph: "SlamGraph", show: Show) -> _Way:
    """Run one recording after the other, until all are done or an interruption."""
    way = _Way()
    for number, part in enumerate(parts, start=1):
        if number > 1:
            graph.begin_recording()
        way.tracked.append(None)
        try:
            with show(f"{number}/{len(parts)} {part.recording.name}") as progress:
                tracked = _track(part, graph, progress, way.voxel_size_m)
        except NoScanError as error:
            way.missing.append(str(error))
            way.interrupted = error.interrupted
        except KeyboardInterrupt:
            way.missing.append(f"{part.request.source}: interrupted")
            way.interrupted = True
        else:
            if tracked.global_map is not None:
                way.voxel_size_m = way.voxel_size_m or tracked.global_map.voxel_size_m
            # The map is drawn anew from the graph, so that this one may go.
            way.tracked[-1] = replace(tracked, global_map=None)
            way.interrupted = isinstance(tracked.error, KeyboardInterrupt)
        if way.interrupted:
            way.missing += [f"{left.request.source}: not begun" for left in parts[number:]]
            break
    return way


def _track(part: _Part, graph: "SlamGraph", progress: Progress, voxel_size_m: float | None) -> Tracked:
    """Run one recording, on voxels of the size that those before had: one map has one size."""
    request = part.request
    if voxel_size_m is not None:
        request = _with_voxels(request, voxel_size_m)
    chosen = range(len(part.recording))
    with closing(open_odometry(request.config, None)) as odometry:
        return track(request, part.recording, chosen, odometry, ScanLog(), graph, Viewer(), progress)


def _with_voxels(request: RunRequest, voxel_size_m: float) -> RunRequest:
    global_map = request.config.global_map.model_copy(update={"voxel_size_m": voxel_size_m})
    return replace(request, config=request.config.model_copy(update={"global_map": global_map}))


def _write(
    request: MergeRequest,
    directory: RunDirectory,
    parts: Sequence[_Part],
    way: _Way,
    graph: "SlamGraph",
    started: float,
) -> MergeOutcome:
    """Optimise the graph, and write the runs and what they have in common."""
    scans = [0 if tracked is None else len(tracked.log) for tracked in way.tracked]
    finished = None if way.voxel_size_m is None else FinishedGraph.of_recordings(graph, scans, way.voxel_size_m)
    joined = [] if finished is None else finished.joined
    if way.voxel_size_m is not None:
        parts = [replace(part, request=_with_voxels(part.request, way.voxel_size_m)) for part in parts]
    runs = [
        _write_run(part, tracked, finished, index, index in joined)
        for index, (part, tracked) in enumerate(zip(parts, way.tracked, strict=False))
    ]
    runs += [None] * (len(parts) - len(runs))
    common = None if finished is None else finished.common()
    # First, because it says whose files the others are.
    directory.write_text(files.CONFIG, dump_yaml(request.config, _describe(request)))
    written = WrittenMap(0, way.voxel_size_m, 0)
    if common is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(common.keyframe_poses, common.edges))
        views = _all_views(way, scans, joined, common)
        drawn = drawn_map(common.global_map, views, request.config.global_map)
        written = write_map(directory, drawn, request.pcd)
    recordings = [_entry(part, run, index in joined) for index, (part, run) in enumerate(zip(parts, runs, strict=True))]
    summary = MergeSummary(
        recordings=tuple(recordings),
        elapsed_s=time.perf_counter() - started,
        peak_rss_mb=peak_rss_mb(),
        graph=None if common is None else GraphSummary.of(common),
        map=written,
        warnings=_warnings(recordings, runs, way.missing),
    )
    directory.write_json(files.SUMMARY, summary.to_json())
    stopped = [
        f"{part.request.source}: stopped after {run.summary.scans} scans: {run.stopped}"
        for part, run in zip(parts, runs, strict=True)
        if run is not None and run.stopped is not None
    ]
    return MergeOutcome(summary, tuple(runs), (*stopped, *way.missing))


def _all_views(way: _Way, scans: Sequence[int], joined: Sequence[int], common: GraphOutcome) -> PlacedViews:
    """The views of all recordings of the common map: one sees through what another saw there."""
    parts, begin = [], 0
    for recording in joined:
        tracked, end = way.tracked[recording], begin + scans[recording]
        if tracked is not None:
            parts.append(tracked.views.placed(common.T_world_lidar[begin:end]))
        begin = end
    return PlacedViews.join(parts)


def _write_run(
    part: _Part, tracked: Tracked | None, finished: FinishedGraph | None, index: int, is_joined: bool
) -> RunOutcome | None:
    """The run of one recording, its poses as the graph corrected them."""
    if tracked is None:
        return None
    closed: GraphOutcome | None = None if finished is None else finished.outcome([index])
    if closed is not None:
        tracked.log.correct(closed.T_world_lidar)
    if not is_joined:
        tracked.log.warn(_OF_ITS_OWN)
    drawn = final_map(tracked, closed, part.request.config.global_map)
    return write_results(part.directory, part.request, tracked, closed, drawn)


def _entry(part: _Part, run: RunOutcome | None, is_joined: bool) -> MergedRecording:
    return MergedRecording(
        name=part.recording.name,
        directory=None if run is None else part.name,
        source=str(part.request.source.resolve()),
        scans=0 if run is None else run.summary.scans,
        length_m=0.0 if run is None else run.summary.length_m,
        lost_scans=0 if run is None else run.summary.lost_scans,
        joined=is_joined,
    )


def _warnings(
    recordings: Sequence[MergedRecording], runs: Sequence[RunOutcome | None], missing: Sequence[str]
) -> tuple[str, ...]:
    """What kept recordings out of the common map, then what their runs warn of."""
    apart = [
        f"{entry.directory}: left out of the common map, because none of its places was surely found in the others."
        f" Give recordings that share more of the way; the loops in {files.SUMMARY} say what did not convince"
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
    return (*apart, *missing, *own)
