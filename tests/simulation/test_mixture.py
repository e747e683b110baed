"""Mixtures are drawn by a seed and a number alone."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.mixture import MIXED_WORLDS, Excerpt, ingredients_of, mixture
from lidarslam.simulation.motion import MOUNTS
from lidarslam.simulation.recorder import Simulation

SEED = 0
SCANS = 3


@pytest.fixture(scope="module")
def drawn() -> list[Excerpt]:
    return list(mixture(2, SCANS, SEED))


@dataclass
class Numbered:
    """A recording whose scans are stamped with their number; remembers which were asked for."""

    count: int
    made: list[int] = field(default_factory=list)
    name = "numbered"
    ground_truth = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))

    def __len__(self) -> int:
        return self.count

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        for number in range(self.count)[start:stop:step]:
            self.made.append(number)
            yield Scan(np.ones((1, 3)), float(number))


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [((), [10, 11, 12, 13]), ((1, 99), [11, 12, 13]), ((0, None, 3), [10, 13]), ((2, 1), [])],
)
def test_an_excerpt_is_a_recording_of_its_own(chosen, expected):
    whole = Numbered(20)
    excerpt = Excerpt(whole, 10, 4)
    assert len(excerpt) == 4
    assert [scan.stamp for scan in excerpt.scans(*chosen)] == expected
    assert whole.made == expected
    assert excerpt.name == "numbered@10"
    assert excerpt.ground_truth is whole.ground_truth


def simulation(excerpt: Excerpt) -> Simulation:
    assert isinstance(excerpt.whole, Simulation)
    return excerpt.whole


@pytest.mark.long
def test_recordings_are_as_their_ingredients_say(drawn):
    for number, excerpt in enumerate(drawn):
        of, made = ingredients_of(number, SEED), simulation(excerpt)
        assert (of.world, of.sensor, of.carrier) == (made.world.name, made.sensor.name, made.motion.name)
        assert of.mount in MOUNTS
    drawn_names = [vars(ingredients_of(number, SEED)) for number in range(len(MIXED_WORLDS))]
    assert {of["world"] for of in drawn_names} == set(MIXED_WORLDS)
    assert min(len({of[kind] for of in drawn_names}) for kind in ("sensor", "carrier")) > 2


def test_the_draw_of_a_number_does_not_change():
    """What is added to the registries leaves prepared training data and measured figures as they are."""
    first = [tuple(vars(ingredients_of(number, SEED)).values()) for number in range(3)]
    assert first == [
        ("street", "os1-64", "handheld", "upright", None),
        ("office", "livox", "legged", "upside-down", None),
        ("tunnel", "vlp-16", "handheld", "upright", None),
    ]


def test_a_number_is_the_same_whatever_comes_before_it(drawn):
    (alone,) = mixture(1, SCANS, SEED, first=1)
    again, there = simulation(alone), simulation(drawn[1])
    assert (alone.name, alone.first) == (drawn[1].name, drawn[1].first)
    np.testing.assert_array_equal(again.T_body_lidar, there.T_body_lidar)
    scan, other = next(iter(alone.scans())), next(iter(drawn[1].scans()))
    assert scan.points.tobytes() == other.points.tobytes()
    assert scan.time_offsets.tobytes() == other.time_offsets.tobytes()
