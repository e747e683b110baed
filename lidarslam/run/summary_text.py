"""The text that `lidarslam run` prints at the end."""

from collections.abc import Iterator
from pathlib import Path

from lidarslam.core.text import as_typed, command_line, count, joined, scan_span, small_length, up_to
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics
from lidarslam.mapping.global_map.drawing import TiledMap
from lidarslam.run.results import RunOutcome
from lidarslam.run.summary import GraphSummary, RunSummary, WrittenMap
from lidarslam.storage.directory import MAP_PLY, MAP_TILES, REPORT, SCANS_CSV, SUMMARY

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
    latency, slowest = summary.latency_ms, summary.slowest
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
    if written.tiled is not None:
        return f"{_tiles(written.tiled)}{fields}{moved}; {MAP_PLY}: {count(written.points, 'point')}, one per {voxel}"
    return f"map of {count(written.points, 'point')}, voxels of {voxel}{fields}{moved}{entropy}"


def _tiles(tiled: TiledMap) -> str:
    voxel, tiles = small_length(tiled.tiling.voxel_size_m), count(len(tiled.points), "tile")
    return f"map of {count(tiled.total, 'point')} in {tiles}, {MAP_TILES}/, voxels of {voxel}"


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
