"""Mixtures are drawn by a seed and a number alone."""

import numpy as np
import pytest

from lidarslam.simulation.mixture import MIXED_WORLDS, ingredients_of, mixture
from lidarslam.simulation.motion import MOUNTS
from lidarslam.simulation.recorder import Simulation

SEED = 0
SCANS = 3


@pytest.fixture(scope="module")
def drawn() -> list[Simulation]:
    return list(mixture(2, SCANS, SEED))


@pytest.mark.long
def test_recordings_are_as_their_ingredients_say(drawn):
    for number, excerpt in enumerate(drawn):
        of, made = ingredients_of(number, SEED), excerpt
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
    assert (alone.name, alone.first) == (drawn[1].name, drawn[1].first)
    np.testing.assert_array_equal(alone.T_body_lidar, drawn[1].T_body_lidar)
    scan, other = next(iter(alone.scans())), next(iter(drawn[1].scans()))
    assert scan.points.tobytes() == other.points.tobytes()
    assert scan.time_offsets.tobytes() == other.time_offsets.tobytes()
