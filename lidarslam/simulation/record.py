"""One recording on disk: the scans in files of a format, the exact trajectory, the exact map, a README."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import cannot_write
from lidarslam.core.point_files import write_ply
from lidarslam.core.tasks import SERIAL, Where, open_tasks
from lidarslam.core.text import as_typed, command_line, count, joined, small_length
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.mesh import world_mesh
from lidarslam.simulation.recorder import Rig, SimulatedScan, Simulation, clock_s, simulation_of
from lidarslam.simulation.reference_map import KeyArray, SeenSurfaces, sample_seen
from lidarslam.simulation.world import choose
from lidarslam.simulation.writers import FORMATS


@dataclass(frozen=True)
class RecordRequest:
    """A recording to be made; the same request gives the same bytes."""

    out: Path  # the folder it becomes
    world: str  # names in their registries
    sensor: str
    motion: str
    mount: str
    scans: int
    seed: int  # of the world, the motion and the noise
    format: str
    speed_mps: float | None = None  # unless a bend slows it down, instead of the carrier's own and the route's limit
    imu: bool = False  # whether an IMU is recorded too
    overwrite: bool = False  # whether an earlier recording in `out` is replaced
    where: Where = SERIAL  # whether scans are made one after another or side by side

    @property
    def moved(self) -> str:
        """The carrier, and its speed where it is not the default."""
        return self.motion + (f" at {self.speed_mps:g} m/s" if self.speed_mps is not None else "")


@dataclass(frozen=True)
class RecordingSummary:
    source: Path  # the argument for `lidarslam run`
    rate_hz: float  # of the sensor, sweeps a second
    scans: int
    points_per_scan: int  # mean
    duration_s: float  # from the first stamp to the last
    length_m: float
    map_points: int
    map_spacing_m: float  # between the points of the reference map
    size_mb: float  # of the whole folder


README = "README.md"
GROUND_TRUTH = "ground_truth.tum"  # where every reader of recordings without a layout of their own looks for it
REFERENCE_MAP = "map.ply"  # no digit in the name, or the reader of scan folders would take it for a scan
MADE_BY = "Made by `lidarslam simulate`"

_FILES = (README, GROUND_TRUTH, REFERENCE_MAP, *{name for row in FORMATS.values() for name in row.files})


@contextlib.contextmanager
def new_folder(out: Path, overwrite: bool = False) -> Iterator[Path]:
    """A path to make a folder at; it becomes `out` when the block ends without an error, else it is removed.

    Its last part is that of `out`, as formats name files after their folder. With `overwrite` an earlier simulated
    recording is replaced, but no folder with other files.

    Raises:
        OutputError: the path exists already, or cannot be written.
    """
    out = out.resolve()
    try:
        _refuse_to_replace(out, overwrite)
        out.parent.mkdir(parents=True, exist_ok=True)
        # Next to its final place, so that renaming is enough; hidden, so that a killed process leaves nothing to find.
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.partial-", dir=out.parent) as workplace:
            folder = Path(workplace) / out.name
            yield folder
            _refuse_to_replace(out, overwrite)
            if out.exists():
                out.rename(Path(workplace) / "earlier")
            folder.rename(out)
    except OSError as error:
        raise cannot_write(out, error) from error


def _refuse_to_replace(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: a file is in the way; name another folder")
    names = sorted(entry.name for entry in out.iterdir()) if out.exists() else []
    if not names:
        return
    readme = out / README
    if not readme.is_file() or MADE_BY not in readme.read_text(encoding="utf-8", errors="replace"):
        raise OutputError(f"{out}: holds other files ({_listing(names)}); name another folder")
    if not overwrite:
        raise OutputError(f"{out}: holds a recording already; name another folder, or replace it with --overwrite")
    others = [name for name in names if not any(fnmatchcase(name, pattern) for pattern in _FILES)]
    if others:
        raise OutputError(f"{out}: holds more than a simulated recording ({_listing(others)}); move that away first")


def _listing(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


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
    """The README as Markdown; its command makes the same recording again."""
    made = FORMATS[request.format]
    words = ["lidarslam", "simulate", "--out", str(request.out), "--world", request.world, "--sensor", request.sensor]
    words += ["--motion", request.motion]
    words += ["--speed", f"{request.speed_mps:g}"] if request.speed_mps is not None else []
    words += ["--mount", request.mount, "--scans", str(summary.scans), "--seed", str(request.seed)]
    words += ["--imu"] if request.imu else []
    return _README.format(
        **vars(request) | vars(summary) | {"imu": _IMU.format(where=made.imu) if request.imu else ""},
        made_by=MADE_BY,
        version=version("lidarslam"),
        simulate=command_line(*words, "--format", request.format),
        moved=request.moved,
        layout=made.layout,
        ground_truth=GROUND_TRUTH,
        reference_map=REFERENCE_MAP,
        spacing=small_length(summary.map_spacing_m),
        info=command_line("lidarslam", "info", str(summary.source)),
        run=command_line("lidarslam", "run", str(summary.source)),
    )


def format_summary(request: RecordRequest, summary: RecordingSummary) -> str:
    """The last lines of `lidarslam simulate`."""
    how = f"{request.mount}, {request.moved}"
    lines = (
        f"{count(summary.scans, 'scan')} of a {request.sensor} ({how}) in {request.world}, seed {request.seed}",
        f"{summary.length_m:.1f} m in {summary.duration_s:.1f} s, {summary.points_per_scan:,} points per scan,"
        f" reference map of {summary.map_points:,} points",
        f"written to {request.out} ({request.format}, {summary.size_mb:.0f} MB); {README} there says what is what",
        f"next: {command_line(as_typed('lidarslam'), 'run', str(summary.source))}",
    )
    return joined(lines)


# Scans of a task.
_CHUNK = 10


def make_simulation(request: RecordRequest) -> Simulation:
    parts = (request.world, request.sensor, request.motion, request.mount)
    return simulation_of(*parts, request.scans, request.seed, request.speed_mps)


def make_scans(request: RecordRequest, simulation: Simulation, seen: SeenSurfaces) -> Iterator[SimulatedScan]:
    """The scans of a simulation of the request, in order; the surfaces they saw are added."""
    if request.where.is_serial:
        for index in range(len(simulation)):
            yield _sweep(simulation, index, seen)
        return
    alone, count = replace(request, where=SERIAL), len(simulation)
    chunks = [(alone, range(first, min(first + _CHUNK, count))) for first in range(0, count, _CHUNK)]
    with open_tasks(request.where) as tasks:
        for made, keys in tasks.run(_chunk, chunks, ahead=2 * tasks.slots):
            seen.add_keys(keys)
            yield from made


def _sweep(simulation: Simulation, index: int, seen: SeenSurfaces) -> SimulatedScan:
    echoes = simulation.echoes(index)
    seen.add_sweep(echoes, simulation.sensor.ranging.min_range_m)
    return simulation.scan(index, echoes)


def _chunk(task: tuple[RecordRequest, range]) -> tuple[list[SimulatedScan], KeyArray]:
    """Some scans, as far as they are written, and the keys of the surfaces they saw."""
    request, indices = task
    simulation, seen = _simulation_of_process(request), SeenSurfaces()
    made = [replace(_sweep(simulation, index, seen), true_ranges=None, moving=None) for index in indices]
    return made, seen.keys()


_simulation_of_process = lru_cache(maxsize=1)(make_simulation)  # built once in each process


def record(request: RecordRequest, progress: Callable[[int, int], None] = lambda *_: None) -> RecordingSummary:
    """Make the recording's folder; it appears when everything in it is complete.

    After every scan `progress` is called with its number from 1 and how many there will be.

    Raises:
        InputError: no world, sensor, motion, mount or format has that name, the motion cannot follow the world's
            route, or the format holds no IMU.
        OutputError: the folder holds something already, or cannot be written.
    """
    chosen = choose("recording format", request.format, FORMATS)
    if request.imu and not chosen.imu:
        raise InputError(f"the format {request.format} has no place for an IMU; choose another, or leave out --imu")
    with new_folder(request.out, request.overwrite) as folder:
        simulation = make_simulation(request)
        sensor, spacing_m = simulation.sensor, simulation.world.map_spacing_m
        seen = SeenSurfaces()
        counts: list[int] = []

        def scans() -> Iterator[SimulatedScan]:
            for simulated in make_scans(request, simulation, seen):
                counts.append(len(simulated.scan))
                yield simulated
                progress(len(counts), len(simulation))

        imu = simulation.imu if request.imu else None
        chosen.write(folder, scans(), Rig(sensor.driver, sensor.period_s, simulation.T_world_lidar_at, imu))
        truth = simulation.ground_truth
        stamps = np.array([clock_s(stamp, chosen.clock_start_ns) for stamp in truth.stamps])
        Trajectory(stamps, truth.T_world_lidar).save(folder / GROUND_TRUTH)
        true_map = sample_seen(world_mesh(simulation.world), seen, spacing_m)
        columns = np.hstack(true_map).T.astype(np.float32)
        write_ply(folder / REFERENCE_MAP, dict(zip(("x", "y", "z", "nx", "ny", "nz"), columns, strict=True)))
        summary = RecordingSummary(
            source=chosen.source_in(request.out),
            rate_hz=sensor.rate_hz,
            scans=len(simulation),
            points_per_scan=sum(counts) // len(simulation),
            duration_s=truth.duration_s,
            length_m=truth.length_m,
            map_points=len(true_map.points),
            map_spacing_m=spacing_m,
            size_mb=sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6,
        )
        (folder / README).write_text(format_readme(request, summary), encoding="utf-8")
    return summary
