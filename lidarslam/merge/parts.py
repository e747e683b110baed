"""The recordings of a merge: each is tracked as a task of its own, and leaves its result in a run directory."""

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, chdir, closing, nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import only_writer
from lidarslam.core.state import Saved, decode, encode, read_state, write_state
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.core.text import safe_name
from lidarslam.datasets.fetched import fetch
from lidarslam.datasets.published.evalio import resolved
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MapFormat
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.run.checkpoints import describe_computed
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import begin_graph
from lidarslam.run.request import RunRequest, require_apart
from lidarslam.run.results import TrackedScans
from lidarslam.run.run import NoScanError, Progress, RunSession, open_odometry, track
from lidarslam.storage.directory import RunDirectory, files_in
from lidarslam.storage.finished_run import read_summary
from lidarslam.storage.unfinished import About, CheckpointFiles, Unfinished

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
        names += [entry["directory"] or "" for entry in read_summary(out).get("recordings", [])]
    with suppress(InputError):
        about = About.read(out)
        names += [] if about is None else about.description.get("parts", [])
    return {name for name in names if _PART.fullmatch(name)}


def read_part(saved: Saved) -> TrackedScans:
    """The recording of a file."""
    return decode(TrackedScans, saved.value("part"))  # type: ignore[no-any-return]


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
        files = CheckpointFiles(out)
        files.make_folder()
        stack.enter_context(only_writer(files.folder, _PATIENCE_S))
        description = describe_computed(task.request, recording) | task.merge
        is_begun = About.read(out) is not None
        unfinished = stack.enter_context(Unfinished.claim(RunDirectory(out, files_in(out)), description, is_begun))
        if unfinished.files.tracked.is_file():
            earlier = read_part(read_state(unfinished.files.tracked))
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
        write_state(files.tracked, {"part": encode(scans), "graph": graph.state()})
        if not scans.interrupted:
            for path in (files.state, files.tiles):  # the state is not resumed any more
                path.unlink(missing_ok=True)
        return PartDone(len(scans.log), interrupted=scans.interrupted)


def _open_graph(config: Config, unfinished: Unfinished) -> KeyframeGraph:
    """The graph of one recording, new or as it was saved; with loop closures only where they correct the local map."""
    graph: KeyframeGraph | None = None
    if config.mapping.method == "surfels" and config.pose_graph.corrects_local_map:
        graph = begin_graph(config, file=unfinished.files.submaps)
    graph = graph or KeyframeGraph(config.pose_graph.keyframes, file=unfinished.files.submaps)
    if unfinished.saved is not None:
        graph.restore(unfinished.saved.part("graph"))
    return graph
