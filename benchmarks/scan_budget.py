"""The slowest scans of scan-to-map registration where tracking is lost, with and without a time budget per scan.

    python benchmarks/scan_budget.py
    python benchmarks/scan_budget.py --faults carried --places office --budgets-ms 0 60

Prints a Markdown table with a row per fault, place and budget (`mapping.budget_ms`; 0: none), without an odometry:

- median, p99, max: of the scans from the sixth on; one registration: the longest single one;
- lost: scans; back: scans from the end of the fault to the first that is not lost, and to the first that is ok;
- off: error of the last scan's position, in the world of the first scan.

Milliseconds are CPU time of the thread, as is the clock of the budget here, so that other programs have no effect.
"""

import time
from collections.abc import Iterator
from unittest.mock import patch

import numpy as np
from mapping_accuracy import make_parser, make_simulation, print_header, print_row
from simulated_faults import Faulty, carried_off, covered, dropped, index_back
from threadpoolctl import threadpool_limits

from lidarslam.core.geometry import inverse
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.registration import register
from lidarslam.mapping.tracking import scan_matcher
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.recorder import Simulation

# World, sensor, carrier.
_PLACES = {"office": ("office", "vlp-16", "tracked"), "street": ("street", "os1-64", "car")}
_FAULTS = ("covered", "carried", "ahead", "gap")
_SCANS, _AT, _WARM_UP = 150, 90, 5


def recorded(fault: str, simulation: Simulation) -> Faulty:
    """A recording with a fault."""
    if fault == "covered":
        return covered(simulation, _AT, _AT + 20, "empty")
    if fault == "carried":
        return carried_off(simulation, _AT, index_back(simulation, _AT, 5.0), 90.0)
    if fault == "ahead":
        return carried_off(simulation, _AT - 30, _AT + 5, 90.0)
    return dropped(simulation, range(_AT, _AT + 30))


def rows(fault: str, place: str, faulty: Faulty, budgets_ms: list[float]) -> Iterator[list[str]]:
    """Rows of all budgets."""
    for budget_ms in budgets_ms:
        registration_ms = []

        def timed(*args: object, **kwargs: object) -> object:
            started = time.thread_time()
            result = register(*args, **kwargs)  # type: ignore[arg-type]
            registration_ms.append(1e3 * (time.thread_time() - started))  # noqa: B023
            return result

        mapper = Mapper(MappingConfig(budget_ms=budget_ms or None), clock=time.thread_time)
        results, ms = [], []
        with patch.object(scan_matcher, "register", timed):
            for scan in faulty.scans:
                started = time.thread_time()
                results.append(mapper.process(mapper.sample(scan), Prior()))
                ms.append(1e3 * (time.thread_time() - started))
        late, after = np.array(ms[_WARM_UP:]), [result.status for result in results[faulty.after :]]
        back = [next((n for n, one in enumerate(after) if one in these), None) for these in _BACK]
        truth = inverse(faulty.truth.T_world_lidar[0]) @ faulty.truth.T_world_lidar[-1]
        off_m = float(np.linalg.norm(results[-1].state.T_world_lidar[:3, 3] - truth[:3, 3]))
        times = (np.median(late), np.percentile(late, 99.0), late.max(), max(registration_ms[_WARM_UP:]))
        lost = sum(result.status is Status.LOST for result in results)
        counts = [str(lost), *("never" if one is None else str(one) for one in back)]
        name = f"{budget_ms:g} ms" if budget_ms else "none"
        yield [fault, place, name, *(f"{value:.0f}" for value in times), *counts, f"{off_m:.3f}"]


_BACK = ({Status.OK, Status.DEGRADED}, {Status.OK})


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--faults", nargs="+", choices=_FAULTS, default=_FAULTS)
    parser.add_argument("--places", nargs="+", choices=list(_PLACES), default=list(_PLACES))
    parser.add_argument("--budgets-ms", nargs="+", type=float, default=[0.0, 100.0, 50.0])
    arguments = parser.parse_args()
    header = ["fault", "place", "budget", "median", "p99", "max", "one registration"]
    print_header([*header, "lost", "back: found", "back: ok", "off, m"])
    with threadpool_limits(1, "blas"):
        for place in arguments.places:
            world, sensor, carrier = _PLACES[place]
            simulation = make_simulation(world, carrier, sensor, _SCANS, 0)
            for fault in arguments.faults:
                for cells in rows(fault, place, recorded(fault, simulation), arguments.budgets_ms):
                    print_row(cells)


if __name__ == "__main__":
    main()
