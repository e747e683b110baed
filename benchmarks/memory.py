"""Growth of memory over a long run.

    python benchmarks/memory.py lap --world hall --motion tracked --scans 20000
    python benchmarks/memory.py rooms --scans 20000 [--lost-every 600]
    python benchmarks/memory.py still --scans 100000

- lap: a sensor circles in a simulated place;
- rooms: it stands in a synthetic room, and with `--lost-every N` in another one every N scans, where a map begins after
  20 lost scans;
- still: a few hundred points per scan, always the same but for the noise, without mapping: data that a run keeps per
  scan. The global map merges its points after 20,000 instead of a million, whose sawtooth would hide everything else.

The scans go from memory into the pipeline of `lidarslam run`, which logs them and saves its state, in a temporary
folder. Prints a Markdown table with a row every `--every` scans: resident memory of the process, and its peak since the
previous row; size of the saved state; cells of the local map; points of the global map; scans lost and degraded, and
maps started since the previous row; position error, with the first poses aligned; wall time per scan, including the
simulator. Below it, the growth over the second half. Linux only: memory is read from /proc.
"""

import argparse
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mapping_accuracy import make_parser, make_simulation, print_header, print_row

from lidarslam.config.settings import Config, load_config
from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map import global_map
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.odometry_gate import where_needed
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.checkpoints import Checkpoints
from lidarslam.run.summary import ScanLog
from lidarslam.simulation.motion import CARRIERS
from lidarslam.simulation.world import WORLDS
from lidarslam.storage.directory import STATE, RunDirectory, Unfinished

_NOISE_M, _ROOM_POINTS, _STILL_POINTS = 0.005, 1_000, 300
_WITHOUT_ODOMETRY = ["odometry.method=constant-velocity"]
_HEADER = (
    "scans", "memory, MB", "peak, MB", "state, MB", "cells", "map points", "lost", "degraded", "maps started",
    "error, m", "ms per scan",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """State after a number of scans."""

    scans: int
    memory_mb: float
    most_mb: float
    state_mb: float
    cells: int
    map_points: int
    lost: int
    degraded: int
    maps_begun: int
    error_m: float
    ms_a_scan: float


@dataclass(frozen=True, eq=False)
class Case:
    """Scans, settings, a prior trajectory or none, and the error of a result, NaN if unknown."""

    scans: Iterable[Scan]
    config: Config
    prior: Trajectory | None = None
    error_m: Callable[[ScanEstimate], float] = lambda _: float("nan")


def lap(options: argparse.Namespace) -> Case:
    """Laps of a simulated place."""
    simulation = make_simulation(options.world, options.motion, "vlp-16", options.scans, 0)

    def error_m(result: ScanEstimate) -> float:
        T_world_first, T_world_lidar = simulation.T_world_lidar_at(np.array([0.0, result.stamp]))
        return float(np.linalg.norm((inverse(T_world_first) @ T_world_lidar - result.T_world_lidar)[:3, 3]))

    return Case(simulation.scans(), load_config(None, _WITHOUT_ODOMETRY), error_m=error_m)


def rooms(options: argparse.Namespace) -> Case:
    """One room, or one after another."""

    def scans() -> Iterator[Scan]:
        rng = np.random.default_rng(0)
        for number in range(options.scans):
            if number % (options.lost_every or options.scans) == 0:
                walls = _room(rng)
            yield Scan(walls + _NOISE_M * rng.normal(size=walls.shape), 0.1 * number)

    return Case(scans(), load_config(None, [*_WITHOUT_ODOMETRY, "global_map.voxel_size_m=0.25"]))


def _room(rng: np.random.Generator) -> FloatArray:
    """Points (N, 3) on the walls of a room, from a random pose in it."""
    half = rng.uniform([3.0, 3.0, 1.2], [6.0, 6.0, 2.0])
    walls = rng.uniform(-1.0, 1.0, (_ROOM_POINTS, 3))
    walls[np.arange(_ROOM_POINTS), rng.integers(0, 3, _ROOM_POINTS)] = rng.choice([-1.0, 1.0], _ROOM_POINTS)
    turn = rng.uniform(-np.pi, np.pi)
    R_world_room = exp(np.array([0.0, 0.0, turn, 0.0, 0.0, 0.0]))[:3, :3]
    return np.asarray((walls - rng.uniform(-0.6, 0.6, 3)) * half @ R_world_room.T)


def still(options: argparse.Namespace) -> Case:
    """The same walls of a room for hours, without mapping."""
    global_map._MIN_PENDING = 20_000
    settings = ["odometry.method=external", "mapping.method=off", "global_map.voxel_size_m=0.1"]
    config = load_config(None, [*settings, f"checkpoints.every_scans={options.every // 2}"])

    def scans() -> Iterator[Scan]:
        rng = np.random.default_rng(0)
        axis, side = rng.integers(0, 3, _STILL_POINTS), rng.choice([-1.0, 1.0], _STILL_POINTS)
        walls = rng.uniform(-1.0, 1.0, (_STILL_POINTS, 3))
        walls[np.arange(_STILL_POINTS), axis] = side
        for number in range(options.scans):
            yield Scan(walls * [5.0, 4.0, 1.5] + _NOISE_M * rng.normal(size=walls.shape), 0.1 * number)

    ends = Trajectory(np.array([0.0, 0.1 * options.scans]), np.tile(np.eye(4), (2, 1, 1)))
    return Case(scans(), config, prior=ends)


def watch(case: Case, every: int) -> list[Row]:
    """Run and print rows."""
    rows: list[Row] = []
    with ExitStack() as stack:
        directory = stack.enter_context(RunDirectory.create(Path(stack.enter_context(TemporaryDirectory()))))
        unfinished = stack.enter_context(Unfinished.claim(directory, {}, resume=False))
        log, localiser = ScanLog(), make_localiser(case.config)
        odometry = where_needed(make_odometry(case.config.odometry, case.prior), case.config)
        checkpoints = Checkpoints(unfinished, case.config.checkpoints, odometry, log, None)
        pipeline = Pipeline(odometry, localiser, case.config.global_map, None, checkpoints)
        mapper, state = localiser.mapper, unfinished.run / STATE
        statuses, begun, most_mb, started = Counter[Status](), 0, 0.0, time.perf_counter()
        for number, result in enumerate(pipeline.run(prefetch(iter(case.scans))), 1):
            log.add(result)
            statuses[result.status] += 1
            begun, most_mb = begun + ("a new map begins" in result.message), max(most_mb, resident_mb())
            if number % every:
                continue
            row = Row(
                scans=number,
                memory_mb=resident_mb(),
                most_mb=most_mb,
                state_mb=state.stat().st_size / 2**20 if state.exists() else 0.0,
                cells=0 if mapper is None or mapper.local_map is None else len(mapper.local_map),
                map_points=0 if pipeline.map.global_map is None else len(pipeline.map.global_map.points()),
                lost=statuses[Status.LOST],
                degraded=statuses[Status.DEGRADED],
                maps_begun=begun,
                error_m=case.error_m(result),
                ms_a_scan=1e3 * (time.perf_counter() - started) / every,
            )
            rows.append(row)
            print_row([f"{value:,}" if isinstance(value, int) else f"{value:,.2f}" for value in asdict(row).values()])
            statuses, begun, most_mb, started = Counter(), 0, 0.0, time.perf_counter()
    return rows


def resident_mb() -> float:
    """Resident memory of this process, 1024 x 1024 bytes each."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def growth(rows: list[Row]) -> str:
    """Slopes of straight lines through the second half, in words."""
    half = rows[len(rows) // 2 :]
    if len(half) < 3:
        return "Too few rows for a slope."
    scans = [row.scans for row in half]

    def slope(name: str) -> float:
        return float(np.polyfit(scans, [getattr(row, name) for row in half], 1)[0])

    return (
        f"Slopes of straight lines through the second half: {2**20 * slope('memory_mb'):.0f} bytes of memory and"
        f" {2**20 * slope('state_mb'):.0f} of saved state per scan; {1e3 * slope('cells'):.0f} cells and"
        f" {1e3 * slope('map_points'):.0f} points per 1,000 scans."
    )


def main() -> None:
    parser = make_parser(__doc__)
    cases = {"lap": lap, "rooms": rooms, "still": still}
    parser.add_argument("case", choices=cases)
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--world", choices=list(WORLDS), default="office")
    parser.add_argument("--motion", choices=list(CARRIERS), default="handheld")
    parser.add_argument("--lost-every", type=int, help="scans from one room to the next")
    options = parser.parse_args()
    print_header(_HEADER)
    print(f"\n{growth(watch(cases[options.case](options), options.every))}")


if __name__ == "__main__":
    main()
