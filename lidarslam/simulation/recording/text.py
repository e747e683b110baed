"""The README of a simulated recording, and the summary that `lidarslam simulate` prints."""

from importlib.metadata import version

from lidarslam.core.text.plain_text import as_typed, command_line, count, joined, small_length
from lidarslam.simulation.recording.folder import GROUND_TRUTH, MADE_BY, README, REFERENCE_MAP
from lidarslam.simulation.recording.request import RecordingSummary, RecordRequest
from lidarslam.simulation.writers.registry import find_format

_README = """\
# Simulated recording: {world}, {sensor}

{made_by} (version {version}); the same command makes the same recording again:

    {simulate}

| | |
|---|---|
| world | {world}, seed {seed} |
| sensor | {sensor}, {rate_hz:g} Hz |
| mounted | {mount} |
| moved | {moved} |
| scans | {scans:,} in {duration_s:.1f} s, {length_m:.1f} m |
| points | {points_per_scan:,} a scan |

## Files

- **The scans** are in {layout}.
{imu}- **{ground_truth}**: the exact pose of the sensor at each scan's stamp, T_world_lidar, as
  `stamp tx ty tz qx qy qz qw`.
- **{reference_map}**: {map_points:,} points with normals, exact, on the surfaces that the sensor saw, about
  {spacing} apart, in the same world frame; nothing that moves is in it.

## Frames and times

- **world**: z is up; the trajectory need not begin at the origin.
- **lidar**: the frame of the points; x forward, y to the left, z up as the sensor is built.
- A scan is one sweep, and its **stamp** is the sweep's start. The sensor moves during the sweep: every ray is cast
  from the pose at its own time.

## Use

    {info}
    {run}

`run` finds the ground truth by itself and writes the errors to metrics.json.
"""

_IMU = """\
- **The IMU** is a MEMS unit of 200 Hz on the LiDAR, with noise and walking biases;
  {where}.
"""


def format_readme(request: RecordRequest, summary: RecordingSummary) -> str:
    """The README as Markdown."""
    return _README.format(
        **vars(request) | vars(summary) | {"imu": _imu(request)},
        made_by=MADE_BY,
        version=version("lidarslam"),
        simulate=_simulate_command(request, summary),
        moved=request.moved,
        layout=find_format(request.format).layout,
        ground_truth=GROUND_TRUTH,
        reference_map=REFERENCE_MAP,
        spacing=small_length(summary.map_spacing_m),
        info=command_line("lidarslam", "info", str(summary.source)),
        run=_run_command(summary),
    )


def format_summary(request: RecordRequest, summary: RecordingSummary) -> str:
    """The last lines of `lidarslam simulate`."""
    how = f"{request.mount}, {request.moved}"
    lines = (
        f"{count(summary.scans, 'scan')} of a {request.sensor} ({how}) in {request.world}, seed {request.seed}",
        f"{summary.length_m:.1f} m in {summary.duration_s:.1f} s, {summary.points_per_scan:,} points per scan,"
        f" reference map of {summary.map_points:,} points",
        f"written to {request.out} ({request.format}, {summary.size_mb:.0f} MB); {README} there says what is what",
        f"next: {_run_command(summary, as_typed('lidarslam'))}",
    )
    return joined(lines)


def _imu(request: RecordRequest) -> str:
    return _IMU.format(where=find_format(request.format).imu) if request.imu else ""


def _simulate_command(request: RecordRequest, summary: RecordingSummary) -> str:
    """The command that makes the same recording again."""
    words = ["lidarslam", "simulate", "--out", str(request.out), "--world", request.world, "--sensor", request.sensor]
    words += ["--trajectory", str(request.trajectory)] if request.trajectory is not None else []
    words += ["--motion", request.motion]
    words += ["--speed", f"{request.speed_mps:g}"] if request.speed_mps is not None else []
    words += ["--mount", request.mount, "--scans", str(summary.scans), "--seed", str(request.seed)]
    words += ["--imu"] if request.imu else []
    return command_line(*words, "--format", request.format)


def _run_command(summary: RecordingSummary, program: str = "lidarslam") -> str:
    return command_line(program, "run", str(summary.source))
