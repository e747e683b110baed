"""The sensor's carrier in its scans: found where it stays at one place while the scene passes by, and nowhere else."""

from collections.abc import Iterator

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.datasets.carrier import carrier_in
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import open_recording

# Lowest and highest corners of boxes: houses at uneven distances along a street, and the street's end.
STREET = [((x, y, -2.0), (x + 7.0, y + 6.0, 6.0)) for x, y in [(-31, 9), (-20, 7), (-8, 11), (4, 8), (15, 10), (27, 6)]]
STREET += [((x, -y - 6.0, -2.0), (x + 8.0, -y, 5.0)) for x, y in [(-28, 8), (-15, 11), (-4, 7), (9, 9), (21, 12)]]
CORRIDOR = [
    ((-60.0, 1.2, -2.0), (60.0, 2.0, 3.0)),
    ((-60.0, -2.0, -2.0), (60.0, -1.2, 3.0)),
    ((25, -2, -2), (26, 2, 3)),
]
ROOM = [((-25.0, 3.0, -2.0), (-15.0, 4.0, 3.0)), ((-25.0, -4.0, -2.0), (-15.0, -3.0, 3.0))]
ROOM += [((-25.0, -3.0, -2.0), (-24.0, 3.0, 3.0)), ((-16.0, -3.0, -2.0), (-15.0, 3.0, 3.0))]
# A cabin behind the sensor and a panel to its left, in its own frame.
CABIN = [((-1.6, -1.5, -1.2), (-0.8, 1.5, 1.5)), ((-1.0, 0.9, -1.2), (3.0, 1.2, 1.0))]


def directions() -> FloatArray:
    elevations, azimuths = np.meshgrid(np.deg2rad(np.linspace(-20.0, 14.0, 24)), np.deg2rad(np.arange(-180.0, 180.0)))
    across = np.cos(elevations)
    return np.stack([across * np.cos(azimuths), across * np.sin(azimuths), np.sin(elevations)], axis=-1).reshape(-1, 3)


def ranges(rays: FloatArray, origin: FloatArray, boxes: list, ground_m: float = np.inf) -> FloatArray:
    """Distances (N,) to the nearest of the boxes along rays (N, 3), or to the ground that far below."""
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(rays[:, 2] < 0.0, -ground_m / rays[:, 2], np.inf)
        for low, high in boxes:
            near, far = (np.asarray(corner) - origin for corner in (low, high))
            enter = np.minimum(near / rays, far / rays).max(axis=1)
            leave = np.maximum(near / rays, far / rays).min(axis=1)
            nearest = np.where((enter > 0.0) & (enter < leave), np.minimum(nearest, enter), nearest)
    return np.asarray(nearest)


def drive(scene: list, carrier: list, count: int = 24, rest: int = 0, people: int = 0) -> Iterator[FloatArray]:
    """Scans (N, 3) of a sensor that first rests, and then drives, amid people."""
    rng, rays = np.random.default_rng(0), directions()
    for number in range(count):
        near = [(x, y, -1.8) for x, y in rng.uniform([-22.5, -2.0], [-17.5, 2.0], (people, 2)) if abs(y) > 0.5]
        there = [(low, np.add(low, [0.5, 0.4, 1.8])) for low in near]
        seen = ranges(rays, np.array([0.8 * max(0, number - rest) - 20.0, 0.0, 0.0]), scene + there, 1.8)
        nearest = np.minimum(seen, ranges(rays, np.zeros(3), carrier)) + rng.normal(0.0, 0.01, len(rays))
        within = nearest < 60.0
        yield nearest[within, None] * rays[within]


@pytest.mark.parametrize("rest", [0, 6])
def test_a_carrier_is_removed_and_the_scene_is_kept(rest):
    carrier = carrier_in(drive(STREET, CABIN, rest=rest))
    assert carrier is not None
    rays = directions()
    own = ranges(rays, np.zeros(3), CABIN)
    own = own[np.isfinite(own), None] * rays[np.isfinite(own)]
    assert len(carrier.remove(Scan(own, 0.0))) < 0.05 * len(own), "all but some at its edges"
    without = next(drive(STREET, []))
    assert len(carrier.remove(Scan(without, 0.0))) > 0.99 * len(without), "and hardly any of the scene"


@pytest.mark.parametrize(
    "scans",
    [
        drive(STREET, []),
        drive(STREET, CABIN, rest=24),
        drive(CORRIDOR, []),
        drive(STREET, CABIN[1:]),
        drive(ROOM, [], rest=24, people=30),
        iter([]),
        iter([np.zeros((0, 3))] * 3),
    ],
    ids=["none", "at rest", "corridor", "one wall", "people", "no scan", "empty scans"],
)
def test_no_carrier_is_found_without_certainty(scans):
    assert carrier_in(scans) is None


def test_a_recording_is_read_without_its_carrier_unless_it_is_kept(tmp_path):
    clouds = list(drive(STREET, CABIN, 33))
    for number, points in enumerate(clouds):
        np.save(tmp_path / f"{number:03d}.npy", points.astype(np.float32))
    kept = open_recording(tmp_path, ReaderConfig(carrier="keep"))
    removed = open_recording(tmp_path)
    assert len(next(kept.scans()).points) == len(clouds[0])
    assert 0.3 * len(clouds[0]) < len(next(removed.scans(5)).points) < 0.8 * len(clouds[0])
    assert not any("carrier" in warning for warning in kept.warnings)
    assert any("reader.carrier=keep" in warning for warning in removed.warnings)
    assert any("reader.carrier=keep" in note for note in removed.describe().notes)
