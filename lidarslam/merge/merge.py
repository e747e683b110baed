"""Multi-session map merging on disk: each recording becomes a run, all that loop closures connect one map."""

import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, chdir, closing, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarslam.config.settings import Config, dump_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.files import make_own_folder, only_writer
from lidarslam.core.state import decode, encode, read_state, write_state
from lidarslam.core.tasks import SERIAL, Where, open_tasks
from lidarslam.core.text import count, joined, safe_name
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.fetched import fetch, url_of
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.published.evalio import resolved
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MapFormat
from lidarslam.mapping.global_map.global_map import voxel_size_for
from lidarslam.mapping.global_map.moved_points import PlacedViews
from lidarslam.mapping.pose_graph.correction import format_g2o
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.pipeline.threads import BackgroundWorker
from lidarslam.run.checkpoints import WITHOUT_EFFECT, describe_computed
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import FinishedGraph, begin_graph
from lidarslam.run.progress import show_count
from lidarslam.run.request import RunRequest, describe_run, require_apart
from lidarslam.run.results import (
    RunOutcome,
    Tracked,
    TrackedScans,
    draw,
    format_map,
    unless_damaged,
    write_map,
    write_results,
)
from lidarslam.run.run import NoScanError, Progress, RunSession, open_odometry, track
from lidarslam.run.summary import GraphSummary, WrittenMap, graph_and_map_json, peak_rss_mb
from lidarslam.storage import directory as files
from lidarslam.storage.directory import About, RunDirectory, Unfinished, files_in, remove_checkpoint, remove_run
from lidarslam.storage.finished_run import read_summary

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

# The names that `open_parts` gives to directories; other directories in a summary must not be removed.
_PART = re.compile(r"\d{2,}_[\w.-]+")


@dataclass(frozen=True)
class MergeRequest:
    """Several recordings to be merged into one map."""

    # two recordings or more, each once; the first of those that are connected gives the frame
    sources: tuple[Path, ...]
    out: Path  # the directory of the merged map
    config: Config  # loops are closed regardless of it
    map_formats: tuple[MapFormat, ...] = ()  # formats of the maps besides .ply
    overwrite: bool = False  # whether an earlier merge, or a run, in `out` is replaced
    resume: bool = False  # whether the merge in `out`, which was killed or stopped, is continued
    where: Where = SERIAL  # where recordings are tracked

    def describe(self) -> dict[str, Any]:
        """For config.yaml, and for the parts of an unfinished merge."""
        return {"version": version("lidarslam"), "sources": [str(resolved(source)) for source in self.sources]}


def open_parts(request: MergeRequest) -> list[tuple[RunRequest, Recording]]:
    """The run of each recording; directories count from 1 and take the recordings' names, as file names allow."""
    if len(request.sources) < 2:
        raise InputError("expected two recordings or more; for the map of a single one use lidarslam run")
    parts: list[tuple[RunRequest, Recording]] = []
    for number, source in enumerate(request.sources, start=1):
        if source.resolve() in {earlier.source.resolve() for earlier, _ in parts}:
            raise InputError(f"{source}: is named twice; name every recording once")
        require_apart(request.out, source)
        recording = open_recording(source, request.config.reader)
        if not len(recording):
            raise InputError(f"{source}: holds no scan; leave it out")
        name = safe_name(re.sub(r"[^\w.-]+", "_", recording.name).strip("._"))
        out = request.out / f"{number:02d}_{name}"
        require_apart(out, source)
        parts.append((RunRequest(source, out, request.config, map_formats=request.map_formats), recording))
    about = None if request.overwrite or request.resume else About.read(request.out)
    if about is not None:
        raise OutputError(f"{request.out}: {about.remedy(request.out)}")
    return parts


def earlier_parts(out: Path) -> set[str]:
    """The directories of the recordings of an earlier merge, finished or not."""
    names: list[str] = []
    with suppress(InputError):
        names += [str(entry["directory"]) for entry in read_summary(out).get("recordings", [])]
    with suppress(InputError):
        about = About.read(out)
        names += [] if about is None else about.description.get("parts", [])
    return {name for name in names if _PART.fullmatch(name)}


def read_part(run: Path) -> TrackedScans:
    """The scans that the task of a recording left; those of all recordings need not fit into memory."""
    return decode(TrackedScans, read_state(run / files.TRACKED)["part"])  # type: ignore[no-any-return]


# A process whose node was lost may run for some more seconds.
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
    interrupted: bool = False  # whether there are more scans


def track_part(task: PartTask, show: Show = lambda _: nullcontext(lambda _number, _total, _result: None)) -> PartDone:
    """Track a recording, from its last checkpoint where there is one; nothing is done where it was tracked before."""
    out = task.request.out
    with ExitStack() as stack:
        with suppress(OSError):  # a machine without that folder has no file there either
            stack.enter_context(chdir(task.folder))
        if task.url is not None:
            fetch(task.url, task.request.source)
        if About.read(out.parent) is None:
            raise OutputError(
                f"{out.parent}: is not shared by the nodes of the cluster; name a folder that is with --out"
            )
        interruptions = stack.enter_context(Interruptions())
        recording = open_recording(task.request.source, task.request.config.reader)
        make_own_folder(out / files.UNFINISHED)
        stack.enter_context(only_writer(out / files.UNFINISHED, _PATIENCE_S))
        description = describe_computed(task.request, recording) | task.merge
        is_begun = About.read(out) is not None
        unfinished = stack.enter_context(Unfinished.claim(RunDirectory(out, files_in(out)), description, is_begun))
        if (out / files.TRACKED).is_file():
            earlier = read_part(out)
            if not earlier.interrupted:
                return PartDone(len(earlier.log))
        graph = stack.enter_context(closing(_open_graph(task.request.config, unfinished)))
        odometry = stack.enter_context(closing(open_odometry(task.request.config, None)))
        try:
            session = RunSession(task.request, RunDirectory(out), odometry, unfinished=unfinished)
            with show(task.name) as progress:
                scans = track(session, recording, range(len(recording)), progress, graph).scans
        except NoScanError as error:
            unfinished.end(stopped=False)
            missing = f"{task.request.source}: interrupted" if error.interrupted else str(error)
            return PartDone(0, missing, error.interrupted)
        interruptions.protect_results()
        graph.end_recording()
        write_state(out / files.TRACKED, {"part": encode(scans), "graph": graph.state()})
        if not scans.interrupted:
            for name in (files.STATE, files.TILES):  # the state is not resumed any more
                (out / name).unlink(missing_ok=True)
        return PartDone(len(scans.log), interrupted=scans.interrupted)


def _open_graph(config: Config, unfinished: Unfinished) -> KeyframeGraph:
    """The graph of one recording, new or as it was saved; with loop closures only where they correct the local map."""
    graph: KeyframeGraph | None = None
    submaps = unfinished.run / files.SUBMAPS
    if config.mapping.method == "surfels" and config.pose_graph.corrects_local_map:
        graph = begin_graph(config, file=submaps)
    graph = graph or KeyframeGraph(config.pose_graph.keyframes, file=submaps)
    if unfinished.saved is not None:
        graph.restore(unfinished.saved["graph"])
    return graph


@dataclass(frozen=True)
class MergedRecording:
    """One recording of a merge, as in summary.json."""

    name: str  # of the recording
    directory: str | None  # of its run, next to the common map; None when no scan could be used
    source: str  # its path
    # scans, length_m, lost_scans: of its run
    scans: int
    length_m: float
    lost_scans: int
    joined: bool  # whether its poses are in the common frame


# In the summary of a run; that of the merge says how to correct it.
_OF_ITS_OWN = "its poses are in a frame of its own: nothing joins it to the other recordings"


@dataclass(frozen=True)
class MergeOutcome:
    """A merge that was written."""

    recordings: tuple[MergedRecording, ...]
    runs: tuple[RunOutcome | None, ...]  # of each recording; None where none of its scans could be used
    stopped: tuple[str, ...]  # which recordings ended before their last scan, and why, a line each
    elapsed_s: float
    graph: GraphSummary | None
    map: WrittenMap
    warnings: tuple[str, ...]

    @property
    def lost_scans(self) -> int:
        return sum(recording.lost_scans for recording in self.recordings)

    @property
    def apart(self) -> list[str]:
        """The directories of the recordings that are not in the common map."""
        return [one.directory for one in self.recordings if not one.joined and one.directory is not None]

    def to_json(self) -> dict[str, Any]:
        """The content of summary.json."""
        own = {"elapsed_s": self.elapsed_s, "peak_rss_mb": peak_rss_mb(), "lost_scans": self.lost_scans}
        recordings = [vars(recording) for recording in self.recordings]
        return {"recordings": recordings} | own | graph_and_map_json(self.graph, self.map, self.warnings)


@dataclass(eq=False)
class Part:
    """A recording of a merge, with its run directory."""

    request: RunRequest
    recording: Recording
    directory: RunDirectory
    done: PartDone | None = None  # once it was tracked

    @property
    def scans(self) -> int:
        return 0 if self.done is None else self.done.scans


def missing(parts: Sequence[Part]) -> list[str]:
    """Why there is no scan of some recordings, a line each."""
    return [part.done.missing for part in parts if part.done is not None and part.done.missing]


def write_merge(
    request: MergeRequest, directory: RunDirectory, parts: Sequence[Part], graph: "SlamGraph", started: float
) -> MergeOutcome:
    """Optimise the graph, and write the runs and the common map."""
    global_map = parts[0].request.config.global_map
    result, voxel_size_m = graph.finish(), global_map.voxel_size_m
    finished, common, joined = None, None, []
    if result is not None and voxel_size_m is not None:
        finished = FinishedGraph(graph, result, voxel_size_m, global_map.most_points)
        joined = finished.joined
    runs = tuple(_write_run(part, finished, index, index in joined) for index, part in enumerate(parts))
    # First, because it identifies the other files.
    directory.write_text(files.CONFIG, dump_yaml(request.config, request.describe()))
    written, beyond = WrittenMap(0, voxel_size_m, 0), None
    if finished is not None and (common := finished.common()) is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(common.keyframe_poses, common.edges))
        tracked = ((finished.result.scan_poses(index), read_part(parts[index].request.out)) for index in joined)
        views = PlacedViews.join([one.views.placed(poses[: len(one.log)]) for poses, one in tracked])
        drawn = draw(common.global_map, views, request.config.global_map, directory)
        if drawn.failure is not None:
            raise drawn.failure
        written, beyond = write_map(directory, drawn, request.map_formats), drawn.warning
    recordings = tuple(
        MergedRecording(
            name=part.recording.name,
            directory=None if run is None else part.request.out.name,
            source=str(resolved(part.request.source)),
            scans=part.scans,
            length_m=0.0 if run is None else run.summary.length_m,
            lost_scans=0 if run is None else run.summary.lost_scans,
            joined=index in joined,
        )
        for index, (part, run) in enumerate(zip(parts, runs, strict=True))
    )
    stopped = [
        f"{part.request.source}: stopped after {run.summary.scans} scans: {run.stopped}"
        for part, run in zip(parts, runs, strict=True)
        if run is not None and run.stopped is not None
    ]
    outcome = MergeOutcome(
        recordings=recordings,
        runs=runs,
        stopped=(*stopped, *missing(parts)),
        elapsed_s=time.perf_counter() - started,
        graph=None if common is None else common.summary,
        map=written,
        warnings=(*_warnings(recordings, runs), *missing(parts), *filter(None, [beyond])),
    )
    directory.write_json(files.SUMMARY, outcome.to_json())
    return outcome


def _write_run(part: Part, finished: FinishedGraph | None, index: int, is_joined: bool) -> RunOutcome | None:
    """The run of one recording, its poses as the graph corrected them; its map is rebuilt from the graph."""
    if not part.scans:
        return None
    request, scans = part.request, read_part(part.request.out)
    truth = unless_damaged(lambda: part.recording.ground_truth, scans.log, "no metrics")
    closed = None if finished is None else finished.outcome([index])
    if closed is not None:
        scans.log.correct(closed.T_world_lidar[: len(scans.log)])
    if not is_joined:
        scans.log.warn(_OF_ITS_OWN)
    tracked = Tracked(scans, recording=part.recording, truth=truth)
    return write_results(part.directory, request.config, describe_run(request), tracked, closed, request.map_formats)


def _warnings(recordings: Sequence[MergedRecording], runs: Sequence[RunOutcome | None]) -> Iterator[str]:
    """Recordings that are not in the common map, and the warnings of runs."""
    for entry in recordings:
        if not entry.joined and entry.directory is not None:
            yield (
                f"{entry.directory}: left out of the common map, because no loop closure with the others was accepted."
                " Give recordings that share more of the way;"
                f" the loops in {files.SUMMARY} say why each was rejected"
            )
    for entry, run in zip(recordings, runs, strict=True):
        for warning in () if run is None else run.summary.warnings:
            if warning != _OF_ITS_OWN:
                yield f"{entry.directory}: {warning}"


def format_merge(out: Path, outcome: MergeOutcome) -> str:
    """A merge in a few lines: each recording, the loops between them, the common map, warnings, and the directory."""
    recordings, graph = outcome.recordings, outcome.graph
    lines = [_recording(recording, run) for recording, run in zip(recordings, outcome.runs, strict=True)]
    closed = [loop for loop in (() if graph is None else graph.loops) if loop.accepted]
    between = sum(len(set(loop.recordings or ())) > 1 for loop in closed)
    lines.append(
        f"{sum(one.joined for one in recordings)} of {len(recordings)} recordings in one map;"
        f" loops closed: {between} between recordings, {len(closed) - between} within"
    )
    lines += [format_map(outcome.map), *(f"warning: {warning}" for warning in outcome.warnings)]
    if outcome.lost_scans:
        lost = count(outcome.lost_scans, "scan")
        lines.append(f"tracking was lost on {lost}; the summaries of the recordings say where")
    return joined([*lines, f"written to {out}"])


def _recording(recording: MergedRecording, run: RunOutcome | None) -> str:
    if run is None:
        return f"{recording.name}: no scan used"
    ate = "" if run.metrics is None else f", ATE {run.metrics.errors.ate_rmse_m:.3f} m by itself"
    lost = f", {recording.lost_scans:,} lost" if recording.lost_scans else ""
    size = f"{count(recording.scans, 'scan')}, {recording.length_m:.1f} m"
    frame = "in the common frame" if recording.joined else "NOT JOINED"
    return f"{recording.directory}: {size}{ate}{lost}, {frame}"


def merge(request: MergeRequest, show: Show) -> MergeOutcome:
    """Run every recording, find the later ones in the earlier ones, and write the map of all.

    A damaged recording ends at the damage; an interruption ends the merge with the results so far. A
    recording that no loop joins to the others has a run of its own and is left out of the common map. A merge that was
    killed or interrupted can be resumed.
    """
    started = time.perf_counter()
    if request.config.odometry.method == "external":
        raise ConfigError(
            "odometry.method is external: one trajectory is not that of several recordings; choose another"
        )
    request = replace(request, config=request.config.having("pose_graph", enabled=True))
    runs, earlier = open_parts(request), earlier_parts(request.out)
    names = {run.out.name for run, _ in runs}
    config = _on_common_voxels(request.config, [recording for _, recording in runs])
    with Interruptions() as interruptions:
        with ExitStack() as stack:
            directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite, request.resume))
            computed = request.config.model_dump(mode="json", exclude=WITHOUT_EFFECT)
            description = request.describe() | {"merge": "all", "parts": sorted(names)} | computed
            unfinished = stack.enter_context(Unfinished.claim(directory, description, request.resume))
            unfinished.begin(0)
            parts = []
            for run, recording in runs:
                if run.out.is_symlink():
                    run.out.unlink()
                if request.overwrite:
                    remove_checkpoint(run.out)
                own = stack.enter_context(RunDirectory.create(run.out, request.overwrite, request.resume))
                own.before_change = partial(_replace_earlier, directory, run.out)
                parts.append(Part(replace(run, config=config), recording, own))
            graph = begin_graph(request.config, request.out)
            assert graph is not None
            stack.callback(graph.close)
            _track_all(request, parts, graph, show)
            interruptions.protect_results()
            if not any(part.scans for part in parts):
                raise InputError(f"no scan of any recording could be used: {'; '.join(missing(parts))}")
            outcome = write_merge(request, directory, parts, graph, started)
            for path in (request.out / name for name in earlier - names):
                if path.is_dir() and not path.is_symlink():  # the target of a link is not of this merge
                    remove_run(path)
        interrupted = any(part.done is not None and part.done.interrupted for part in parts)
        for part in reversed(parts):
            about = About.read(part.request.out)
            if about is not None:
                Unfinished(part.request.out, about).end(interrupted)
            if not part.scans:
                with suppress(OSError):  # other files are there
                    part.request.out.rmdir()
        unfinished.end(interrupted)
    return outcome


def _replace_earlier(directory: RunDirectory, part: Path) -> None:
    """Before the results of a recording are replaced: mark those of the earlier merge as incomplete too."""
    directory.before_change()
    about = About.read(part)
    if about is not None:
        Unfinished(part, about).replace_earlier()


def _on_common_voxels(config: Config, recordings: Sequence[Recording]) -> Config:
    """One map has one voxel size: that of the first scan of all, unless it is configured."""
    if config.global_map.voxel_size_m is not None:
        return config
    for recording in recordings:
        with suppress(InputError):  # its scans up to where it is damaged
            for scan in take_in(recording, range(len(recording)), Faults()):
                if len(scan):
                    return config.having("global_map", voxel_size_m=voxel_size_for(scan.points))
    return config


def _track_all(request: MergeRequest, parts: Sequence[Part], graph: "SlamGraph", show: Show) -> None:
    """Track the recordings, until all are done or an interruption; the graph takes each as early as possible."""
    numbered = [f"{number}/{len(parts)} {part.recording.name}" for number, part in enumerate(parts, start=1)]
    merge = {"merge": "part", "sources": request.describe()["sources"]}
    tasks = [
        PartTask(part.request, name, merge, str(Path.cwd()), url_of(part.request.source))
        for part, name in zip(parts, numbered, strict=True)
    ]
    waiting = deque(parts)
    total, with_bar = sum(len(part.recording) for part in parts), not request.where.is_serial
    with closing(BackgroundWorker("graph", len(parts))) as worker, ExitStack() as stack:

        def take(index: int, done: PartDone) -> None:
            parts[index].done = done
            if bar is not None:
                bar(sum(len(part.recording) for part in parts if part.done is not None), total)
            while waiting and waiting[0].done is not None:
                worker.submit(_add, graph, waiting.popleft())

        bar = stack.enter_context(show_count(f"{count(len(parts), 'recording')} side by side")) if with_bar else None
        try:
            with open_tasks(request.where) as at_work:
                function = track_part if with_bar else partial(track_part, show=show)
                for done in at_work.run(function, tasks, take):
                    if done.interrupted:
                        break
        except KeyboardInterrupt:
            pass
        for index, part in enumerate(parts):
            if part.done is None:
                why = "not begun" if About.read(part.request.out) is None else "interrupted"
                take(index, PartDone(0, f"{part.request.source}: {why}", interrupted=True))


def _add(graph: "SlamGraph", part: Part) -> None:
    """Give the graph the keyframes of a recording; those without any count as well."""
    out, config = part.request.out, part.request.config.pose_graph.keyframes
    with closing(KeyframeGraph(config, file=out / files.SUBMAPS if part.scans else None)) as tracked:
        if part.scans:
            tracked.restore(read_state(out / files.TRACKED)["graph"])
        graph.add_recording(tracked)
