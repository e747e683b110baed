"""The results of a merge: the runs of the recordings, corrected by one graph, the common map, and summary.json."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarslam.config.settings import dump_yaml
from lidarslam.core.state import Saved, read_state
from lidarslam.core.text import count, joined
from lidarslam.datasets.published.evalio import resolved
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.global_map.moved_points import PlacedViews
from lidarslam.mapping.pose_graph.correction import format_g2o
from lidarslam.merge.parts import MergeRequest, PartDone, read_part
from lidarslam.run.loop_closing import FinishedGraph
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.run.results import RunOutcome, Tracked, draw, unless_damaged, write_map, write_results
from lidarslam.run.summary import GraphSummary, WrittenMap, graph_and_map_json, peak_rss_mb
from lidarslam.run.summary_text import format_map
from lidarslam.storage import directory as files
from lidarslam.storage.directory import RunDirectory
from lidarslam.storage.unfinished import CheckpointFiles

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph


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


@dataclass(frozen=True)
class MergeSummary:
    """The content of summary.json of a merge."""

    recordings: tuple[MergedRecording, ...]
    elapsed_s: float
    peak_rss_mb: float
    graph: GraphSummary | None
    map: WrittenMap
    warnings: tuple[str, ...]

    @property
    def lost_scans(self) -> int:
        """Number of lost scans of all recordings."""
        return sum(recording.lost_scans for recording in self.recordings)

    def to_json(self) -> dict[str, Any]:
        """The content of summary.json."""
        own = {name: getattr(self, name) for name in ("elapsed_s", "peak_rss_mb", "lost_scans")}
        recordings = [vars(recording) for recording in self.recordings]
        return {"recordings": recordings} | own | graph_and_map_json(self.graph, self.map, self.warnings)


# In the summary of a run; that of the merge says how to correct it.
_OF_ITS_OWN = "its poses are in a frame of its own: nothing joins it to the other recordings"


@dataclass(frozen=True)
class MergeOutcome:
    """A merge that was written."""

    summary: MergeSummary  # in numbers
    runs: tuple[RunOutcome | None, ...]  # of each recording; None where none of its scans could be used
    stopped: tuple[str, ...]  # which recordings ended before their last scan, and why, a line each

    @property
    def apart(self) -> list[str]:
        """The directories of the recordings that are not in the common map."""
        return [one.directory for one in self.summary.recordings if not one.joined and one.directory is not None]


@dataclass(eq=False)
class Part:
    """A recording of a merge, with its run directory."""

    request: RunRequest
    recording: Recording
    directory: RunDirectory
    done: PartDone | None = None  # once it was tracked

    @property
    def scans(self) -> int:
        """Number of scans that were tracked."""
        return 0 if self.done is None else self.done.scans

    @property
    def files(self) -> CheckpointFiles:
        """The files that its task left."""
        return CheckpointFiles(self.request.out)

    def saved(self) -> Saved:
        """The result of its task, read again each time: those of all recordings need not fit into memory."""
        return read_state(self.files.tracked)


def missing(parts: Sequence[Part]) -> list[str]:
    """Why there is no scan of some recordings, a line each."""
    return [part.done.missing for part in parts if part.done is not None and part.done.missing]


def write_merge(
    request: MergeRequest, directory: RunDirectory, parts: Sequence[Part], graph: "SlamGraph", started: float
) -> MergeOutcome:
    """Optimise the graph, and write the runs and the common map."""
    global_map = parts[0].request.config.global_map
    result, voxel_size_m = graph.finish(), global_map.voxel_size_m
    finished = None
    if result is not None and voxel_size_m is not None:
        finished = FinishedGraph(graph, result, voxel_size_m, global_map.most_points)
    joined = [] if finished is None else finished.joined
    runs = tuple(_write_run(part, finished, index, index in joined) for index, part in enumerate(parts))
    common = None if finished is None else finished.common()
    # First, because it identifies the other files.
    directory.write_text(files.CONFIG, dump_yaml(request.config, request.describe()))
    written, beyond = WrittenMap(0, voxel_size_m, 0), None
    if result is not None and common is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(common.keyframe_poses, common.edges))
        tracked = ((index, read_part(parts[index].saved())) for index in joined)
        views = PlacedViews.join([one.views.placed(result.scan_poses(n)[: len(one.log)]) for n, one in tracked])
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
    summary = MergeSummary(
        recordings=recordings,
        elapsed_s=time.perf_counter() - started,
        peak_rss_mb=peak_rss_mb(),
        graph=None if common is None else common.summary,
        map=written,
        warnings=(*_warnings(recordings, runs), *missing(parts), *filter(None, [beyond])),
    )
    directory.write_json(files.SUMMARY, summary.to_json())
    stopped = [
        f"{part.request.source}: stopped after {run.summary.scans} scans: {run.stopped}"
        for part, run in zip(parts, runs, strict=True)
        if run is not None and run.stopped is not None
    ]
    return MergeOutcome(summary, runs, (*stopped, *missing(parts)))


def _write_run(part: Part, finished: FinishedGraph | None, index: int, is_joined: bool) -> RunOutcome | None:
    """The run of one recording, its poses as the graph corrected them; its map is rebuilt from the graph."""
    if not part.scans:
        return None
    scans, request = read_part(part.saved()), part.request
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
    summary = outcome.summary
    lines = [_recording(recording, run) for recording, run in zip(summary.recordings, outcome.runs, strict=True)]
    closed = [loop for loop in (() if summary.graph is None else summary.graph.loops) if loop.accepted]
    between = sum(len(set(loop.recordings or ())) > 1 for loop in closed)
    lines.append(
        f"{sum(one.joined for one in summary.recordings)} of {len(summary.recordings)} recordings in one map;"
        f" loops closed: {between} between recordings, {len(closed) - between} within"
    )
    lines += [format_map(summary.map), *(f"warning: {warning}" for warning in summary.warnings)]
    if summary.lost_scans:
        lost = count(summary.lost_scans, "scan")
        lines.append(f"tracking was lost on {lost}; the summaries of the recordings say where")
    return joined([*lines, f"written to {out}"])


def _recording(recording: MergedRecording, run: RunOutcome | None) -> str:
    if run is None:
        return f"{recording.name}: no scan used"
    parts = [f"{recording.directory}: {count(recording.scans, 'scan')}, {recording.length_m:.1f} m"]
    if run.metrics is not None:
        parts.append(f"ATE {run.metrics.errors.ate_rmse_m:.3f} m by itself")
    if recording.lost_scans:
        parts.append(f"{recording.lost_scans:,} lost")
    parts.append("in the common frame" if recording.joined else "NOT JOINED")
    return ", ".join(parts)
