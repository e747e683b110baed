"""What `lidarslam run` prints at the end."""

from collections.abc import Iterator
from pathlib import Path

from lidarslam.run.directory import SCANS_CSV, SUMMARY
from lidarslam.run.results import RunOutcome
from lidarslam.run.summary import GraphSummary, RunSummary, WrittenMap

# Stretches of lost scans that are spelt out; summary.json has them all.
_STRETCHES = 3


def format_outcome(out: Path, outcome: RunOutcome) -> str:
    """A run in a few lines: what was built, how fast, how good, what went wrong, and where it all lies."""
    return "\n".join(_lines(out, outcome))


def _lines(out: Path, outcome: RunOutcome) -> Iterator[str]:
    summary = outcome.summary
    yield f"{_count(summary.scans, 'scan')}, {summary.length_m:.1f} m in {summary.duration_s:.1f} s"
    speed = "" if summary.realtime_factor is None else f", {summary.realtime_factor:.1f} times real time"
    total = summary.ms_per_scan["total"]
    yield f"{total.median:.0f} ms a scan (95 %: {total.p95:.0f} ms){speed}, {summary.peak_rss_mb:.0f} MB"
    yield format_map(summary.map)
    if summary.graph is not None:
        yield _loops(summary.graph)
    if outcome.metrics is not None:
        yield from _accuracy(outcome)
    for warning in summary.warnings:
        yield f"warning: {warning}"
    yield from _lost(summary)
    yield f"written to {out}"


def format_map(written: WrittenMap) -> str:
    """A line about a map."""
    if written.voxel_size_m is None:
        return "no map: no scan could be believed"
    moved = f"; {_count(written.moved, 'point')} of what moved left out" if written.moved else ""
    voxel_cm = 100.0 * written.voxel_size_m
    crisp = (
        ""
        if written.entropy is None
        else f"; mean entropy {written.entropy:.2f} (of runs of one recording: lower is crisper)"
    )
    return f"map of {_count(written.points, 'point')}, one in every voxel of {voxel_cm:.0f} cm{moved}{crisp}"


def _loops(graph: GraphSummary) -> str:
    moved = f", which moved poses by up to {graph.largest_correction_m:.2f} m" if graph.closed else ""
    refused = len(graph.loops) - graph.closed
    unsure = f" ({refused} more did not convince; {SUMMARY} says why)" if refused else ""
    return f"{_count(graph.keyframes, 'keyframe')}, {_count(graph.closed, 'loop')} closed{moved}{unsure}"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _lost(summary: RunSummary) -> Iterator[str]:
    for stretch in summary.lost[:_STRETCHES]:
        scans = f"scan {stretch.first}" if stretch.first == stretch.last else f"scans {stretch.first} to {stretch.last}"
        yield f"LOST on {scans}: {stretch.reason}"
    if len(summary.lost) > _STRETCHES:
        more = len(summary.lost) - _STRETCHES
        yield f"LOST on {more} more {'stretch' if more == 1 else 'stretches'}"
    if summary.lost_scans:
        scans = _count(summary.scans, "scan")
        yield f"tracking was lost on {summary.lost_scans:,} of {scans}; {SUMMARY} and {SCANS_CSV} say where"


def _accuracy(outcome: RunOutcome) -> Iterator[str]:
    assert outcome.metrics is not None
    errors = outcome.metrics.errors
    yield f"against ground truth: ATE {errors.ate_rmse_m:.3f} m, {errors.ate_rotation_rmse_deg:.2f} deg"
    if outcome.metrics.kitti is not None:
        drift = outcome.metrics.kitti.overall
        yield f"KITTI drift {drift.translation_percent:.2f} %, {100.0 * drift.rotation_deg_per_m:.2f} deg per 100 m"
