"""The time of a scan: searches pause when it is spent, and go on with later scans."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np
import pytest
from simulated_faults import Faulty, carried_off, covered, index_back

from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.tracking import scan_matcher
from lidarslam.mapping.tracking.budget import Budget, Steps
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.simulation.recorder import Simulation

from .runs import NOTHING, light, simulated

AT, COUNT = 50, 90
REGISTRATION_MS, SCORE_MS, BUDGET_MS = 20.0, 0.5, 50.0


@dataclass
class FakeClock:
    """Seconds that pass only where they are said to."""

    s: float = 0.0
    taken_ms: list[float] = field(default_factory=list)

    def __call__(self) -> float:
        return self.s

    def passes(self, ms: float, function: Callable[..., object]) -> Callable[..., object]:
        """The function, which takes so long."""

        def timed(*args: object, **kwargs: object) -> object:
            self.s += 1e-3 * ms
            return function(*args, **kwargs)

        return timed


def taking(clock: FakeClock, steps: int, step_ms: float) -> Steps[str]:
    """A computation whose steps take so long."""
    for _ in range(steps):
        clock.s += 1e-3 * step_ms
        yield
    return "done"


def test_without_a_budget_no_time_is_ever_spent():
    budget = Budget(None, clock := FakeClock())
    for _ in range(5):
        budget.begin(0.1)
        clock.s += 1e6
        assert not budget.is_spent
        assert budget.run(taking(clock, 100, 1e6)) == ("done",)


def test_a_computation_pauses_when_the_time_is_spent_and_goes_on():
    budget = Budget(10.0, clock := FakeClock())
    for _ in range(2):
        budget.begin(0.1)
        clock.s += 1.0
        assert not budget.is_spent  # the first two scans are free
    steps = taking(clock, 25, 1.0)
    for _ in range(2):
        budget.begin(0.1)
        assert budget.run(steps) is None
        assert budget.is_spent
    budget.begin(0.1)
    assert budget.run(steps) == ("done",)


def test_a_computation_goes_on_even_where_nothing_is_left():
    budget = Budget(10.0, clock := FakeClock())
    for _ in range(3):
        budget.begin(0.1)
    clock.s += 1.0
    assert budget.is_spent
    assert [budget.lets_search_on() for _ in range(4)] == [False, True, False, True]  # at every second scan
    assert budget.run(taking(clock, 5, 1.5)) is None
    assert clock.s == pytest.approx(1.003)  # two steps pass a fifth of 10 ms


def test_auto_is_half_of_the_shorter_of_the_last_two_intervals():
    budget = Budget("auto", clock := FakeClock())
    for interval_s, length_s in ((np.inf, np.inf), (0.1, np.inf), (0.1, 0.05), (5.0, 0.05), (0.1, 0.05), (0.2, 0.05)):
        budget.begin(interval_s)
        clock.s += 0.049
        assert not budget.is_spent
        clock.s += 0.002
        assert budget.is_spent == np.isfinite(length_s)


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulated("office", "tracked", light(), COUNT)


@pytest.fixture(scope="module")
def carried(simulation: Simulation) -> Faulty:
    """Three metres back, and turned."""
    return carried_off(simulation, AT, index_back(simulation, AT, 3.0), 120.0)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    """A registration and the score of a start pose take time, all else none."""
    clock = FakeClock()
    monkeypatch.setattr(scan_matcher, "register", clock.passes(REGISTRATION_MS, scan_matcher.register))
    monkeypatch.setattr(scan_matcher, "with_mean_velocity", lambda registration, *_: registration)
    monkeypatch.setattr(scan_matcher, "_distances", clock.passes(SCORE_MS, scan_matcher._distances))
    return clock


def results(mapper: Mapper, faulty: Faulty, clock: FakeClock, first: int = 0) -> Iterator[MappedScan]:
    for scan in faulty.scans[first:]:
        started = clock.s
        yield mapper.process(mapper.sample(scan), NOTHING)
        clock.taken_ms.append(1e3 * (clock.s - started))


@pytest.mark.long
@pytest.mark.parametrize("fault", ["carried", pytest.param("covered", marks=pytest.mark.slow)])
def test_no_scan_takes_more_than_the_budget_and_a_registration_and_tracking_recovers(simulation, carried, clock, fault):
    faulty = carried if fault == "carried" else covered(simulation, AT, AT + 10, "empty")
    mapper = Mapper(MappingConfig(budget_ms=BUDGET_MS), clock=clock)
    mapped = list(results(mapper, faulty, clock))
    assert max(clock.taken_ms[2:]) <= BUDGET_MS + REGISTRATION_MS + 1e-6
    assert any(one.status is Status.LOST for one in mapped[faulty.after :])  # it was spread
    assert [one.status for one in mapped[-5:]] == [Status.OK] * 5
    truth = np.linalg.inv(faulty.truth.T_world_lidar[0]) @ faulty.truth.T_world_lidar
    for one, T in zip(mapped, truth, strict=True):
        if one.status is Status.OK:
            assert np.linalg.norm(one.state.T_world_lidar[:3, 3] - T[:3, 3]) < 0.1


@pytest.mark.long
def test_a_search_that_was_under_way_begins_anew_after_a_resumption(carried, clock):
    config = MappingConfig(budget_ms=BUDGET_MS)
    mapper = Mapper(config, clock=clock)
    searching = results(mapper, carried, clock)
    while next(searching).status is not Status.LOST:
        pass
    number = len(clock.taken_ms) + 1
    resumed = Mapper(config, clock=clock)
    resumed.restore(deepcopy(mapper.state()))
    mapped = list(results(resumed, carried, clock, number))
    assert [one.status for one in mapped[-5:]] == [Status.OK] * 5
