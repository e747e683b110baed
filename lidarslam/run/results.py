"""The results of a run: files in its directory, and the text that `lidarslam run` prints."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lidarslam.config.settings import Config, dump_yaml
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import cannot_write, make_own_folder
from lidarslam.core.geometry import inverse
from lidarslam.core.text import as_typed, command_line, count, joined, scan_span, small_length, up_to
from lidarslam.core.trajectory import Trajectory, format_kitti, format_tum
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.recording import Recording
from lidarslam.evaluation.map.entropy import sampled_map_entropy
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics, evaluate_trajectory
from lidarslam.mapping.config import GlobalMapConfig, MapFormat
from lidarslam.mapping.consistency import PairTest, find_contradictions
from lidarslam.mapping.global_map.global_map import DrawnMap, GlobalMap, TiledMap, drawn_map
from lidarslam.mapping.global_map.moved_points import PlacedViews, Views
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud
from lidarslam.mapping.global_map.voxels import Tile
from lidarslam.mapping.pose_graph.correction import format_g2o
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.run.calibration import Elevation
from lidarslam.run.loop_closing import GraphOutcome
from lidarslam.run.summary import GraphSummary, RunSummary, ScanLog, WrittenMap, summarise
from lidarslam.storage import directory as files
from lidarslam.storage.directory import MAP_INDEX, MAP_PLY, MAP_TILES, REPORT, SCANS_CSV, SUMMARY, RunDirectory

logger = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class TrackedScans:
    """The scans of a recording after the pipeline; a merge keeps them on disk."""

    log: ScanLog
    asked: int  # number of scans that were asked for
    faults: Faults  # scans that were left out, and faults of the others
    views: Views  # range images of some scans, for the removal of moving objects
    slides: list[PairTest]  # pairs of scans, for the detection of slips
    stopped: str | None = None  # why they ended before the last one
    interrupted: bool = False  # whether that was an interruption

    @classmethod
    def of(
        cls,
        log: ScanLog,
        faults: Faults,
        built: MapBuilder,
        asked: int | None = None,
        error: InputError | KeyboardInterrupt | None = None,
    ) -> "TrackedScans":
        """All scans that were processed, unless another number was asked for; `error` ended them early."""
        stopped = None if error is None else reason_of(error)
        asked = len(log) + faults.left_out if asked is None else asked
        return cls(log, asked, faults, built.views, built.slides.tests, stopped, isinstance(error, KeyboardInterrupt))


def reason_of(error: InputError | KeyboardInterrupt) -> str:
    """Why the scans ended early, in words."""
    return str(error) or "interrupted"


@dataclass(frozen=True, eq=False)
class Tracked:
    """The data that results are written from."""

    scans: TrackedScans
    global_map: GlobalMap | None = None  # of the poses before loop closure; None when no scan was added
    # recording, truth: of the scans, and its ground truth; scans may be from elsewhere
    recording: Recording | None = None
    truth: Trajectory | None = None
    elevation: Elevation | None = None  # the error of the sensor's elevations; None where it is unknown


def unless_damaged(read: Callable[[], T], log: ScanLog, consequence: str) -> T | None:
    """Data that came with the recording; None and a warning where it is damaged."""
    try:
        return read()
    except InputError as error:
        log.warn(f"{consequence}: {error}")
        return None


@dataclass(frozen=True)
class RunOutcome:
    """The outcome of a run."""

    summary: RunSummary  # the run in numbers
    metrics: TrajectoryMetrics | None  # its errors; None without ground truth
    stopped: str | None = None  # why it ended before its last scan, None when it did not
    is_resumable: bool = False  # whether it can be continued from a checkpoint


def draw(
    global_map: GlobalMap | None, views: PlacedViews, config: GlobalMapConfig, directory: RunDirectory | None
) -> DrawnMap:
    """The final map; its tiles, if it has any, are written to the directory."""
    if directory is None:
        return drawn_map(global_map, views, config)
    writer = TileWriter(directory)
    drawn = drawn_map(global_map, views, config, writer.write)
    if writer.failure is not None:
        return replace(drawn, tiled=None, failure=writer.failure)
    if drawn.tiled is not None and drawn.tiled.points:
        writer.finish(drawn.tiled)
    return drawn


def corrected_map(
    tracked: Tracked, closed: GraphOutcome | None, config: GlobalMapConfig, directory: RunDirectory | None = None
) -> DrawnMap:
    """The map of a run whose poses are final, which a pose graph may have drawn. Tiles go to the directory."""
    views = tracked.scans.views.placed(tracked.scans.log.trajectory.T_world_lidar)
    return draw(tracked.global_map if closed is None else closed.global_map, views, config, directory)


def write_results(
    directory: RunDirectory,
    config: Config,
    described: dict[str, Any],
    tracked: Tracked,
    closed: GraphOutcome | None = None,
    map_formats: Sequence[MapFormat] = (),
    show: Callable[[DrawnMap], None] = lambda _: None,
) -> RunOutcome:
    """Draw the map and write everything; OutputError where a file fails; a map that fails costs no other file."""
    scans, log = tracked.scans, tracked.scans.log
    drawn = corrected_map(tracked, closed, config.global_map, directory)
    show(drawn)
    failed = drawn.failure
    if failed is not None:
        log.warn(f"the map is an overview without its tiles: {failed}")
    logger.info("writing the results of %s", count(len(log), "scan"))
    directory.write_text(files.CONFIG, dump_yaml(config, described))
    if closed is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(closed.keyframe_poses, closed.edges))
    directory.write_text(files.SCANS_CSV, log.format_csv())
    metrics = _write_trajectories(directory, tracked)
    try:
        written = write_map(directory, drawn, map_formats)
    except OutputError as error:
        written, failed = WrittenMap(0, drawn.voxel_size_m, drawn.moved), error
        log.warn(f"there is no map: {error}")
    log.warnings.extend(scans.faults.warnings())
    log.warn(drawn.warning)
    if drawn.cloud is not None and not len(drawn.cloud):
        log.warn("the map is empty: min_range_m and max_range_m of global_map leave no point")
    skipped = 0 if scans.stopped else scans.asked - len(log) - scans.faults.left_out
    log.warn(f"{count(skipped, 'scan')} of those asked for missing" if skipped else None)
    contradictions = find_contradictions(scans.slides, log.trajectory.T_world_lidar)
    graph = None if closed is None else closed.summary
    unreadable = scans.faults.unreadable_scans + skipped
    summary = summarise(log, written, unreadable, graph, contradictions, tracked.elevation)
    directory.write_json(files.SUMMARY, summary.to_json())
    if failed is not None:
        raise OutputError(f"{failed}; the other results are there") from failed
    return RunOutcome(summary, metrics, scans.stopped)


def write_map(directory: RunDirectory, drawn: DrawnMap, formats: Sequence[MapFormat] = ()) -> WrittenMap:
    """Write a map as .ply and in further formats, unless it is empty."""
    cloud = drawn.cloud
    if cloud is None or not len(cloud):
        return WrittenMap(0, drawn.voxel_size_m, drawn.moved)
    for name in (files.MAP_PLY, *(files.MAPS[one] for one in formats)):
        with directory.replacing(name) as path:
            write_cloud(path, cloud)
    # For an overview it would measure the thinning.
    entropy = sampled_map_entropy(cloud.points) if drawn.tiled is None else None
    fields = tuple(name for name, _ in cloud.attributes.present())
    mean = None if entropy is None else entropy.mean
    return WrittenMap(len(cloud), drawn.voxel_size_m, drawn.moved, mean, fields, drawn.tiled)


def _write_trajectories(directory: RunDirectory, tracked: Tracked) -> TrajectoryMetrics | None:
    log, recording, truth = tracked.scans.log, tracked.recording, tracked.truth
    trajectory = log.trajectory
    directory.write_text(files.TRAJECTORY_TUM, format_tum(trajectory))
    directory.write_text(files.ODOMETRY_TUM, format_tum(log.odometry))
    consequence = f"{files.TRAJECTORY_KITTI} is in the LiDAR's frame"
    T_cam_lidar = unless_damaged(lambda: None if recording is None else recording.T_cam_lidar, log, consequence)
    poses = trajectory.T_world_lidar
    if T_cam_lidar is not None:  # the devkit compares camera poses
        poses = T_cam_lidar @ poses @ inverse(T_cam_lidar)
    directory.write_text(files.TRAJECTORY_KITTI, format_kitti(poses))
    if truth is None:
        return None
    metrics = unless_damaged(lambda: evaluate_trajectory(trajectory, truth), log, "no metrics")
    if metrics is not None:
        directory.write_json(files.METRICS, metrics.to_json())
    return metrics


class TileWriter:
    """Writes the tiles of a map, and then the index, without which they are useless."""

    def __init__(self, directory: RunDirectory) -> None:
        self._directory = directory
        self._entries: dict[Tile, dict[str, Any]] = {}
        self.failure: OutputError | None = None  # of the first tile that could not be written, after which none is

    def write(self, tile: Tile, cloud: PointCloud, brightest: float) -> None:
        """Write a tile, see `WriteTile`; OutputError where there is a file in place of the folder."""
        if self.failure is None and not self._entries:
            self._begin()
        if self.failure is not None:
            return
        name = f"{tile[0]}_{tile[1]}.laz"
        try:
            with self._directory.replacing(f"{MAP_TILES}/{name}") as path:
                write_cloud(path, cloud, brightest)
        except OutputError as error:
            self.failure = error
            for entry in self._entries.values():  # to free the space for the other results
                (self._directory.path / MAP_TILES / entry["file"]).unlink(missing_ok=True)
            return
        low, high = (bound(cloud.points, axis=0).round(4).tolist() for bound in (np.min, np.max))
        self._entries[tile] = {"file": name, "tile": list(tile), "points": len(cloud), "min": low, "max": high}

    def finish(self, tiled: TiledMap) -> None:
        """Write the index; OutputError where it could not be written."""
        index = {
            "frame": "world",  # of trajectory.tum
            "tile_edge_m": round(tiled.tiling.edge_m, 9),
            "voxel_size_m": tiled.tiling.voxel_size_m,
            "points": tiled.total,
            "tiles": [self._entries[tile] for tile in tiled.points],
        }
        self._directory.write_json(MAP_INDEX, index)

    def _begin(self) -> None:
        folder = self._directory.path / MAP_TILES
        self._directory.before_change()
        try:
            make_own_folder(folder)
            (self._directory.path / MAP_INDEX).unlink(missing_ok=True)  # first: tiles of an earlier run are replaced
        except (FileExistsError, NotADirectoryError) as error:
            raise OutputError(f"{folder}: a file is in the way; name another directory") from error
        except OSError as error:
            self.failure = cannot_write(folder, error)


# A speed that differs by less is that of the recording.
_ALIKE = 1.05
# Stretches of lost scans that are listed; summary.json has them all.
_LISTED = 3


def format_outcome(out: Path, outcome: RunOutcome) -> str:
    """A run in a few lines: size, speed, map, loops, accuracy, warnings, and where the files are."""
    return joined(_lines(out, outcome))


def format_stop(out: Path, outcome: RunOutcome) -> str:
    """A line about a run that ended before its last scan."""
    done = f"stopped after {count(outcome.summary.scans, 'scan')}: {outcome.stopped}"
    if outcome.is_resumable:
        return f"{done}; continue with --resume"
    return f"{done}; {out} holds the results so far, but no checkpoint to continue from; --overwrite begins again"


def _lines(out: Path, outcome: RunOutcome) -> Iterator[str]:
    summary = outcome.summary
    yield f"{count(summary.scans, 'scan')}, {summary.length_m:.1f} m in {summary.duration_s:.1f} s"
    yield from format_times(summary)
    if summary.odometry_asked < summary.scans:
        yield f"odometry asked at {summary.odometry_asked:,} of {count(summary.scans, 'scan')}"
    yield format_map(summary.map)
    if summary.graph is not None:
        yield _loops(summary.graph)
    if outcome.metrics is not None:
        yield from _accuracy(outcome.metrics)
    yield from format_end(out, summary)
    yield f"next: {command_line(as_typed('lidarslam'), 'view', str(out))}"
    if outcome.metrics is not None:
        yield f"      {command_line(as_typed('lidarslam'), 'evaluate', str(out))}"


def format_times(summary: RunSummary) -> Iterator[str]:
    """Lines about elapsed time and memory, and about the latency of one scan."""
    elapsed = f"{summary.elapsed_s:.1f} s for all scans, {summary.elapsed_ms_per_scan:.1f} ms per scan"
    yield f"{elapsed}{_speed(summary.realtime_factor)}; {summary.peak_rss_mb:,.0f} MB of memory"
    latency, slowest = summary.latency_ms, summary.slowest_scan
    worst = "" if slowest is None else f"; slowest: scan {slowest.scan:,}, {slowest.ms:.0f} ms of {slowest.stage}"
    yield f"latency of one scan: median {latency.median:.0f} ms, 99 % under {latency.p99:.0f} ms{worst}"


def _speed(realtime_factor: float | None) -> str:
    """By the time of all scans, the first one included, which waits for loops to be compiled and loaded."""
    if realtime_factor is None or realtime_factor <= 0.0:
        return ""
    times = max(realtime_factor, 1.0 / realtime_factor)
    if times < _ALIKE:
        return ", as fast as recorded"
    return f", {times:.1f} times {'faster' if realtime_factor > 1.0 else 'slower'} than recorded"


def format_map(written: WrittenMap) -> str:
    """A line about a map."""
    if written.voxel_size_m is None:
        return "no map: no scan was registered"
    voxel = small_length(written.voxel_size_m)
    fields = f", with {' and '.join(written.fields)}" if written.fields else ""
    moved = f"; {count(written.moved, 'point')} of moving objects removed" if written.moved else ""
    entropy = f"; mean map entropy {written.entropy:.2f} (lower is crisper)" if written.entropy is not None else ""
    if (tiled := written.tiled) is not None:
        tiles = f"map of {count(tiled.total, 'point')} in {count(len(tiled.points), 'tile')}, {MAP_TILES}/"
        overview = f"{MAP_PLY}: {count(written.points, 'point')}, one per {voxel}"
        return f"{tiles}, voxels of {small_length(tiled.tiling.voxel_size_m)}{fields}{moved}; {overview}"
    return f"map of {count(written.points, 'point')}, voxels of {voxel}{fields}{moved}{entropy}"


def _loops(graph: GraphSummary) -> str:
    moved = f", poses corrected by {up_to(graph.largest_correction_m)}" if graph.closed else ""
    rejected = len(graph.loops) - graph.closed
    candidates = f" ({count(rejected, 'candidate')} rejected; {SUMMARY} gives the reasons)" if rejected else ""
    return f"{count(graph.keyframes, 'keyframe')}, {count(graph.closed, 'loop')} closed{moved}{candidates}"


def _accuracy(metrics: TrajectoryMetrics) -> Iterator[str]:
    errors = metrics.errors
    steps = ""
    if errors.rpe_translation_rmse_m is not None and errors.rpe_rotation_rmse_deg is not None:
        steps = f"; from scan to scan {errors.rpe_translation_rmse_m:.3f} m, {errors.rpe_rotation_rmse_deg:.2f} deg"
    yield f"against ground truth: ATE {errors.ate_rmse_m:.3f} m, {errors.ate_rotation_rmse_deg:.2f} deg{steps}"
    if metrics.kitti is not None:
        drift = metrics.kitti.overall
        yield f"KITTI drift {drift.translation_percent:.2f} %, {100.0 * drift.rotation_deg_per_m:.2f} deg per 100 m"
    yield from (f"{name}: {text}" for name, text in metrics.plugin_lines())


def format_end(out: Path, summary: RunSummary) -> Iterator[str]:
    """Warnings, lost scans, and where the files are."""
    for warning in summary.warnings:
        yield f"warning: {warning}"
    for stretch in summary.lost[:_LISTED]:
        yield f"LOST on {scan_span(stretch.first, stretch.last)}: {stretch.reason}"
    if more := max(0, len(summary.lost) - _LISTED):
        yield f"LOST on {more} more {'stretch' if more == 1 else 'stretches'}"
    if summary.lost_scans:
        share = f"{summary.lost_scans:,} of {count(summary.scans, 'scan')}"
        yield f"tracking was lost on {share}; {SUMMARY} and {SCANS_CSV} list them"
    yield f"written to {out}{f'; {REPORT} shows it' if (out / REPORT).is_file() else ''}"
