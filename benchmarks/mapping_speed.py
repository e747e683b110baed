"""Time of scan-to-map registration per scan, by stage, compared with KISS-ICP's `register_frame` on the same scans.

    python benchmarks/mapping_speed.py KITTI/sequences/04
    python benchmarks/mapping_speed.py KITTI/sequences/04 --methods surfels loam
    python benchmarks/mapping_speed.py --simulate hdl-64e:street:car os1-128:street:car --scans 60

Everything runs in sequence in one process, without reading and without the pipeline's threads: ours (without odometry,
to the pose and the updated map) with each mapping of `--methods`, alternating with KISS-ICP with its defaults, for
`--rounds` rounds, each from an empty map, so that other load affects all of them. The first `--warm-up` scans of every
pass do not count. Printed are wall time and CPU time (of all threads) per scan, median and 95th percentile over all
passes; the ratio is that of the medians of adjacent passes: median, smallest and largest.

Ours runs with BLAS on one thread, as in `lidarslam run`; KISS-ICP uses any number of threads. The time of a stage
excludes the stages inside it:

- thin: choosing the points of the scan; LOAM's features;
- registration: finding correspondences and solving for the pose;
- fit: residuals of the result in the map;
- map update: compensating the scan, adding it, removing distant cells;
- rest: prediction and status, and the search when a scan is lost.
"""

import functools
import inspect
import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from mapping_accuracy import make_parser, make_simulation, print_header, print_row
from threadpoolctl import threadpool_limits

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MappingConfig, MappingName
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.sampled_scan import Sampler
from lidarslam.mapping.tracking import scan_matcher
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.pipeline.threads import in_order

_METHODS: tuple[MappingName, ...] = ("surfels", "loam")
# Stage -> owner and name of the timed function.
_STAGES: dict[str, tuple[Any, str]] = {
    "thin": (Sampler, "sample"),
    "registration": (scan_matcher, "register"),
    "fit": (scan_matcher, "measure_fit"),
    "map update": (Mapper, "_insert"),
    "rest": (Mapper, "process"),
}


@dataclass
class Stopwatch:
    """Seconds of each stage without the stages inside it: wall, CPU of all threads, CPU of the calling thread."""

    seconds: dict[str, FloatArray] = field(default_factory=lambda: defaultdict(lambda: np.zeros(3)))
    _inside: list[FloatArray] = field(default_factory=list)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time within to the stage."""
        self._inside.append(np.zeros(3))
        begun = _clocks()
        try:
            yield
        finally:
            taken = _clocks() - begun
            self.seconds[stage] += taken - self._inside.pop()
            if self._inside:
                self._inside[-1] += taken

    def wrap(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed."""

        @functools.wraps(function, updated=())
        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.measure(stage):
                return function(*args, **kwargs)

        return timed

    def replacement(self, stage: str, owner: Any, name: str) -> Any:
        """Timed replacement of a function or a method."""
        is_static = isinstance(inspect.getattr_static(owner, name), staticmethod)
        timed = self.wrap(stage, getattr(owner, name))
        return staticmethod(timed) if is_static else timed


def _clocks() -> FloatArray:
    return np.array([time.perf_counter(), time.process_time(), time.thread_time()])


@dataclass(frozen=True, eq=False)
class _Pass:
    """One method over all scans: milliseconds per scan, wall and CPU (N, 2), in total and by stage."""

    total_ms: FloatArray
    stage_ms: dict[str, FloatArray] = field(default_factory=dict)
    bad: int = 0


def run_ours(scans: Sequence[Scan], method: MappingName, warm_up: int) -> _Pass:
    """Scan-to-map registration without odometry."""
    ours = Mapper(MappingConfig(method=method))
    watches, bad = [], 0
    with threadpool_limits(1, "blas"):
        for scan in scans:
            watch = Stopwatch()
            with ExitStack() as stack:
                for stage, (owner, name) in _STAGES.items():
                    stack.enter_context(patch.object(owner, name, watch.replacement(stage, owner, name)))
                mapped = ours.process(ours.sample(scan), Prior())
            watches.append(watch.seconds)
            bad += mapped.status is not Status.OK
    stage_ms = {stage: 1e3 * np.array([seconds[stage][:2] for seconds in watches[warm_up:]]) for stage in _STAGES}
    return _Pass(np.sum(list(stage_ms.values()), axis=0), stage_ms, bad)


def run_kiss(scans: Sequence[Scan], warm_up: int) -> _Pass:
    """KISS-ICP with its defaults."""
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    kiss = KissICP(load_config(None))
    seconds = []
    for scan in scans:
        times = np.empty(0) if scan.time_offsets is None else scan.time_offsets
        wall, cpu = time.perf_counter(), time.process_time()
        kiss.register_frame(scan.points, times)
        seconds.append((time.perf_counter() - wall, time.process_time() - cpu))
    return _Pass(1e3 * np.array(seconds[warm_up:]))


def compare(name: str, scans: Sequence[Scan], methods: Sequence[MappingName], rounds: int, warm_up: int) -> None:
    """Run all alternately and print their times."""
    for method in methods:  # compiles loops
        run_ours(scans[:8], method, 0)
    ours: dict[MappingName, list[_Pass]] = {method: [] for method in methods}
    kiss: dict[MappingName, list[_Pass]] = {method: [] for method in methods}
    for _, label in itertools.product(range(rounds), methods):
        ours[label].append(run_ours(scans, label, warm_up))
        kiss[label].append(run_kiss(scans, warm_up))
    points = np.median([len(scan) for scan in scans])
    print(f"\n{name}: {len(scans)} scans of {points:,.0f} points, {rounds} rounds; milliseconds per scan\n")
    print_header(
        ["", "wall median", "wall p95", "CPU median", "CPU p95", "Hz", "wall / KISS-ICP's", "CPU / KISS-ICP's"]
    )
    for label, passes in ours.items():
        ratios = [_ratio(passes, kiss[label], kind) for kind in range(2)]
        print_row([label, *_times([one.total_ms for one in passes]), *ratios])
    everything = [one.total_ms for passes in kiss.values() for one in passes]
    print_row(["KISS-ICP", *_times(everything), "1", "1"])
    for label, passes in ours.items():
        _print_stages(label, passes)


def _print_stages(label: str, passes: Sequence[_Pass]) -> None:
    print(f"\nStages, {label} ({passes[-1].bad} scans degraded or lost):\n")
    print_header(["stage", "wall median", "wall p95", "CPU median", "CPU p95"])
    for stage in _STAGES:
        print_row([stage, *_times([one.stage_ms[stage] for one in passes])[:4]])


def _times(passes: Sequence[Any]) -> list[str]:
    """Cells: median and 95th percentile of wall and CPU time, and the rate at the median wall time."""
    wall, cpu = np.concatenate(passes).T
    cells = [f"{value:.1f}" for kind in (wall, cpu) for value in (np.median(kind), np.percentile(kind, 95.0))]
    return [*cells, f"{1e3 / max(float(np.median(wall)), 1e-6):.0f}"]


def _ratio(ours: Sequence[_Pass], kiss: Sequence[_Pass], kind: int) -> str:
    pairs = zip(ours, kiss, strict=True)
    ratios = [np.median(one.total_ms[:, kind]) / np.median(other.total_ms[:, kind]) for one, other in pairs]
    return f"{np.median(ratios):.2f} [{min(ratios):.2f}, {max(ratios):.2f}]"


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings")
    parser.add_argument("--simulate", nargs="+", default=[], metavar="SENSOR:WORLD:MOTION")
    parser.add_argument("--methods", nargs="+", choices=_METHODS, default=["surfels"])
    parser.add_argument("--scans", type=int, default=60, help="maximum per recording")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--warm-up", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if not arguments.sources and not arguments.simulate:
        parser.error("give recordings, or some to simulate with --simulate")
    for source in arguments.sources:
        recording = open_recording(source)
        scans = list(in_order(recording.scans(0, arguments.scans)))
        compare(recording.name, scans, arguments.methods, arguments.rounds, arguments.warm_up)
    for wanted in arguments.simulate:
        sensor, world, motion = wanted.split(":")
        simulation = make_simulation(world, motion, sensor, arguments.scans, arguments.seed)
        scans, name = list(simulation.scans()), f"{sensor}, {world}, {motion}"
        compare(name, scans, arguments.methods, arguments.rounds, arguments.warm_up)


if __name__ == "__main__":
    main()
