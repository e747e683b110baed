"""The report that `lidarslam localise` prints at the end."""

from collections.abc import Iterator

from lidarslam.core.text.plain_text import as_typed, command_line, count, joined, scan_span
from lidarslam.run.modes.localise.localise import LocaliseOutcome
from lidarslam.run.modes.localise.request import LocaliseRequest
from lidarslam.run.summary_text import format_times
from lidarslam.storage.directory import REPORT, SCANS_CSV, SUMMARY

# Stretches of lost scans that are listed; summary.json has them all.
_LISTED = 3


def format_localisation(request: LocaliseRequest, outcome: LocaliseOutcome) -> str:
    """A localisation in a few lines: where it was found, what was tracked, what was lost, and where the files are."""
    return joined(_lines(request, outcome))


def format_not_found(request: LocaliseRequest, outcome: LocaliseOutcome) -> str:
    """A line about a recording that was not found."""
    refused, scans = outcome.localisation.refused, count(outcome.run.summary.scans, "scan")
    last = f"; the last search: {refused[-1][1]}" if refused else ""
    return f"{request.run.source}: not found in {request.map} with {scans}{last}; {SUMMARY} has all reasons"


def _lines(request: LocaliseRequest, outcome: LocaliseOutcome) -> Iterator[str]:
    summary, found, out = outcome.run.summary, outcome.localisation, request.run.out
    yield f"{count(summary.scans, 'scan')}, {summary.length_m:.1f} m in {summary.duration_s:.1f} s"
    yield f"found at scan {found.found}, confirmed at scan {found.confirmed}, after {found.after_s:.1f} s"
    before = f", {found.placed_afterwards:,} before that placed afterwards" if found.placed_afterwards else ""
    yield f"{found.tracked:,} scans tracked in the map{before}, {summary.lost_scans:,} lost"
    yield from format_times(summary)
    for warning in summary.warnings:
        yield f"warning: {warning}"
    for stretch in summary.lost[:_LISTED]:
        yield f"LOST on {scan_span(stretch.first, stretch.last)}: {stretch.reason}"
    if len(summary.lost) > _LISTED:
        yield f"LOST on {len(summary.lost) - _LISTED} more; {SUMMARY} and {SCANS_CSV} list them"
    yield f"written to {out}{f'; {REPORT} shows it' if (out / REPORT).is_file() else ''}"
    yield f"next: {command_line(as_typed('lidarslam'), 'view', str(request.map), str(out))}"
