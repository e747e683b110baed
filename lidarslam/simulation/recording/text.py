"""What is said of a simulated recording: its README, and what `lidarslam simulate` prints."""

import shlex
from collections.abc import Iterator
from importlib.metadata import version
from textwrap import TextWrapper

from lidarslam.simulation.recording.folder import GROUND_TRUTH, MADE_BY, README, REFERENCE_MAP
from lidarslam.simulation.recording.request import RecordingSummary, RecordRequest
from lidarslam.simulation.writers.registry import find_format

_WIDTH = 100


def format_readme(request: RecordRequest, summary: RecordingSummary) -> str:
    """The README as Markdown."""
    return "\n".join(_lines(request, summary)) + "\n"


def command_line(request: RecordRequest, summary: RecordingSummary) -> str:
    """The command that makes the same recording again."""
    words = ["lidarslam", "simulate", "--out", str(request.out), "--world", request.world, "--sensor", request.sensor]
    if request.trajectory is not None:
        words += ["--trajectory", str(request.trajectory)]
    words += ["--motion", request.motion]
    if request.speed_mps is not None:
        words += ["--speed", f"{request.speed_mps:g}"]
    words += ["--mount", request.mount]
    words += ["--scans", str(summary.scans), "--seed", str(request.seed)]
    return shlex.join([*words, "--format", request.format])


def run_command(request: RecordRequest, summary: RecordingSummary) -> str:
    """The command to type next."""
    return shlex.join(["lidarslam", "run", str(summary.source), "--out", f"runs/{request.out.resolve().name}"])


def format_summary(request: RecordRequest, summary: RecordingSummary) -> str:
    """What `lidarslam simulate` prints at the end."""
    how = f"{request.mount}, {_motion(request)}"
    return "\n".join(
        [
            f"{summary.scans:,} scans of a {request.sensor} ({how}) in {request.world}, seed {request.seed}",
            f"{summary.length_m:.1f} m in {summary.duration_s:.1f} s, {summary.points_per_scan:,} points a scan,"
            f" reference map of {summary.map_points:,} points",
            f"written to {request.out} ({request.format}, {summary.size_mb:.0f} MB); {README} there says what is what",
            f"next: {run_command(request, summary)}",
        ]
    )


def _lines(request: RecordRequest, summary: RecordingSummary) -> Iterator[str]:
    yield f"# Simulated recording: {request.world}, {request.sensor}"
    yield ""
    yield f"{MADE_BY} (version {version('lidarslam')}); the same command makes the same recording again:"
    yield ""
    yield f"    {command_line(request, summary)}"
    yield ""
    yield "| | |"
    yield "|---|---|"
    for name, value in _rows(request, summary):
        yield f"| {name} | {value} |"
    yield ""
    yield "## Files"
    yield ""
    yield from _item(f"**The scans** are in {find_format(request.format).layout}.")
    yield from _item(
        f"**{GROUND_TRUTH}**: the exact pose of the sensor at each scan's stamp, T_world_lidar, as"
        " `stamp tx ty tz qx qy qz qw`."
    )
    yield from _item(
        f"**{REFERENCE_MAP}**: {summary.map_points:,} points with normals, exact, on the surfaces that the sensor saw,"
        f" about {100.0 * summary.map_spacing_m:.0f} cm apart, in the same world frame; nothing that moves is in it."
    )
    yield ""
    yield "## Frames and times"
    yield ""
    yield from _item("**world**: z is up; the trajectory need not begin at the origin.")
    yield from _item("**lidar**: the frame of the points; x forward, y to the left, z up as the sensor is built.")
    yield from _item(
        "A scan is one sweep, and its **stamp** is the sweep's start. The sensor moves during the sweep: every ray is"
        " cast from the pose at its own time."
    )
    yield ""
    yield "## Use"
    yield ""
    yield f"    {shlex.join(['lidarslam', 'info', str(summary.source)])}"
    yield f"    {run_command(request, summary)}"
    yield ""
    yield from _paragraph("`run` finds the ground truth by itself and writes how far off it was to metrics.json.")


def _rows(request: RecordRequest, summary: RecordingSummary) -> Iterator[tuple[str, str]]:
    yield "world", f"{request.world}, seed {request.seed}"
    yield "sensor", f"{request.sensor}, {summary.rate_hz:g} Hz"
    yield "mounted", request.mount
    yield "moved", _motion(request)
    yield "scans", f"{summary.scans:,} in {summary.duration_s:.1f} s, {summary.length_m:.1f} m"
    yield "points", f"{summary.points_per_scan:,} a scan"


def _motion(request: RecordRequest) -> str:
    speed = f" at {request.speed_mps:g} m/s" if request.speed_mps is not None else ""
    return f"{request.motion} along {request.trajectory.name}" if request.trajectory else request.motion + speed


def _item(text: str) -> list[str]:
    return _wrapped(text, "- ", "  ")


def _paragraph(text: str) -> list[str]:
    return _wrapped(text, "", "")


def _wrapped(text: str, first: str, others: str) -> list[str]:
    wrapper = TextWrapper(_WIDTH, first, others, break_long_words=False, break_on_hyphens=False)
    return wrapper.wrap(text)
