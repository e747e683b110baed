"""The report that `lidarslam merge` prints at the end."""

from pathlib import Path

from lidarslam.core.text.plain_text import count, joined
from lidarslam.run.modes.merge.summary import MergedRecording, MergeSummary
from lidarslam.run.modes.merge.writing import MergeOutcome
from lidarslam.run.results import RunOutcome
from lidarslam.run.summary_text import format_map


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
