"""Multi-session map merging on disk: each recording becomes a run, all that loop closures connect one map."""

import time
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.tasks import open_tasks
from lidarslam.core.text import count
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.fetched import url_of
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.global_map.global_map import voxel_size_for
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.merge.parts import (
    MergeOutcome,
    MergeRequest,
    Part,
    PartDone,
    PartTask,
    Show,
    earlier_parts,
    missing,
    open_parts,
    track_part,
    write_merge,
)
from lidarslam.pipeline.threads import BackgroundWorker
from lidarslam.run.checkpoints import WITHOUT_EFFECT
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import begin_graph
from lidarslam.run.progress import show_count
from lidarslam.storage.directory import RunDirectory
from lidarslam.storage.unfinished import About, CheckpointFiles, Unfinished, remove_run

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph


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
    pose_graph = request.config.pose_graph.model_copy(update={"enabled": True})
    request = replace(request, config=request.config.model_copy(update={"pose_graph": pose_graph}))
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
                    CheckpointFiles(run.out).remove()
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
                    global_map = config.global_map.model_copy(update={"voxel_size_m": voxel_size_for(scan.points)})
                    return config.model_copy(update={"global_map": global_map})
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
    file = part.files.submaps if part.scans else None
    with closing(KeyframeGraph(part.request.config.pose_graph.keyframes, file=file)) as tracked:
        if part.scans:
            tracked.restore(part.saved().part("graph"))
        graph.add_recording(tracked)
