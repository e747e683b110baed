"""The results of a merge: the runs of the recordings, corrected by one graph, the common map, and summary.json."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarslam.config.settings import dump_yaml
from lidarslam.core.state import Saved
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
from lidarslam.storage.state_file import read_state
from lidarslam.storage.unfinished import CheckpointFiles

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph


@dataclass(frozen=True)
class MergedRecording:
    """One recording of a merge."""

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
        return {
            "recordings": [vars(recording) for recording in self.recordings],
            "elapsed_s": self.elapsed_s,
            "peak_rss_mb": self.peak_rss_mb,
            "lost_scans": self.lost_scans,
            **graph_and_map_json(self.graph, self.map, self.warnings),
        }


# In the summary of a run; that of the merge says how to correct it.
_OF_ITS_OWN = "its poses are in a frame of its own: nothing joins it to the other recordings"


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
    def checkpoint(self) -> CheckpointFiles:
        """The path of its task's result."""
        return CheckpointFiles(self.request.out)

    def saved(self) -> Saved:
        """That result, read again each time: those of all recordings need not fit into memory.

        Raises:
            InputError: the file is damaged.
        """
        return read_state(self.checkpoint.tracked)

    def tracked(self) -> Tracked:
        """The recording as it was tracked; its map is rebuilt from the graph."""
        scans = read_part(self.saved())
        truth = unless_damaged(lambda: self.recording.ground_truth, scans.log, "no metrics")
        return Tracked(scans, recording=self.recording, truth=truth)


def missing(parts: Sequence[Part]) -> list[str]:
    """Why there is no scan of some recordings, a line each."""
    return [part.done.missing for part in parts if part.done is not None and part.done.missing]


def write_merge(
    request: MergeRequest, directory: RunDirectory, parts: Sequence[Part], graph: "SlamGraph", started: float
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
    # First, because it identifies the other files.
    directory.write_text(files.CONFIG, dump_yaml(request.config, request.describe()))
    written, beyond = WrittenMap(0, voxel_size_m, 0), None
    if common is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(common.keyframe_poses, common.edges))
        views, begin = [], 0
        for part in (parts[index] for index in joined):
            if part.scans:
                views.append(read_part(part.saved()).views.placed(common.T_world_lidar[begin : begin + part.scans]))
            begin += part.scans
        drawn = draw(common.global_map, PlacedViews.join(views), request.config.global_map, directory)
        if drawn.failure is not None:
            raise drawn.failure
        written, beyond = write_map(directory, drawn, request.map_formats), drawn.warning
    recordings = tuple(_entry(part, runs[index], index in joined) for index, part in enumerate(parts))
    summary = MergeSummary(
        recordings=recordings,
        elapsed_s=time.perf_counter() - started,
        peak_rss_mb=peak_rss_mb(),
        graph=None if common is None else GraphSummary.of(common),
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
    """The run of one recording, its poses as the graph corrected them."""
    if not part.scans:
        return None
    tracked = part.tracked()
    closed = None if finished is None else finished.outcome([index])
    if closed is not None:
        tracked.scans.log.correct(closed.T_world_lidar)
    if not is_joined:
        tracked.scans.log.warn(_OF_ITS_OWN)
    request = part.request
    return write_results(part.directory, request.config, describe_run(request), tracked, closed, request.map_formats)


def _entry(part: Part, run: RunOutcome | None, is_joined: bool) -> MergedRecording:
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


def format_merge(out: Path, outcome: MergeOutcome) -> str:
    """A merge in a few lines: each recording, the loops between them, the common map, warnings, and the directory."""
    summary = outcome.summary
    lines = [_recording(recording, run) for recording, run in zip(summary.recordings, outcome.runs, strict=True)]
    lines += [_joined(summary), format_map(summary.map), *(f"warning: {warning}" for warning in summary.warnings)]
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


def _joined(summary: MergeSummary) -> str:
    joined = sum(recording.joined for recording in summary.recordings)
    loops = () if summary.graph is None else summary.graph.loops
    closed = [loop for loop in loops if loop.accepted]
    between = sum(len(set(loop.recordings or ())) > 1 for loop in closed)
    return (
        f"{joined} of {len(summary.recordings)} recordings in one map;"
        f" loops closed: {between} between recordings, {len(closed) - between} within"
    )
