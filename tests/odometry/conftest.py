"""Sweeps through boxes, cast analytically: every pixel's point, normal and time are exact, and so are the motions."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import Scan
from lidarslam.odometry.images.sweep_images import SweepImages
from lidarslam.odometry.training.preparation import PreparedRecording

_LOW, _HIGH = np.deg2rad(-18.0), np.deg2rad(18.0)


def stacked(sweeps: Sequence[SweepImages]) -> list[torch.Tensor]:
    """Points and normals (N, 3, H, W), and offsets (N, H, W)."""
    names = ("points", "normals", "offsets")
    return [torch.from_numpy(np.stack([getattr(sweep, name) for sweep in sweeps])) for name in names]


@dataclass(frozen=True)
class Scene:
    """The inside of one box with other boxes in it; walls at infinity are not there.

    A body starts at `start` and moves evenly at a twist (6,), rotation first; sweep i has its middle at i * period.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    boxes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    rows: int = 16
    columns: int = 360
    period_s: float = 0.1

    def sweeps(
        self, count: int, twist: Sequence[float], start: FloatArray | None = None, rolling: bool = True
    ) -> list[SweepImages]:
        """That many sweeps; not rolling: the pose is that of the middle of the sweep all the time."""
        T_world_start = np.eye(4) if start is None else start
        return self.sweeps_along(count, lambda times: T_world_start @ exp(np.multiply.outer(times, twist)), rolling)

    def sweeps_along(
        self, count: int, poses: Callable[[FloatArray], FloatArray], rolling: bool = True
    ) -> list[SweepImages]:
        """The same on any way: poses (W, 4, 4) at times (W,)."""
        offsets = ((np.arange(self.columns) + 0.5) / self.columns - 0.5) * self.period_s * rolling  # (W,)
        return [self._sweep(offsets, poses(i * self.period_s + offsets)) for i in range(count)]

    def _sweep(self, offsets: FloatArray, T: FloatArray) -> SweepImages:
        """A sweep whose columns are seen from poses (W, 4, 4)."""
        elevation = np.linspace(_LOW, _HIGH, self.rows)[:, None]
        azimuth = (np.arange(self.columns) + 0.5) * (2.0 * np.pi / self.columns)
        rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        local = np.stack(np.broadcast_arrays(*rays), axis=-1)  # (H, W, 3)
        ranges, normals = self._cast(T[:, :3, 3], np.einsum("wij,hwj->hwi", T[:, :3, :3], local))
        seen = np.isfinite(ranges)
        points = np.where(seen[..., None], local * np.where(seen, ranges, 0.0)[..., None], 0.0)
        normals = np.einsum("wji,hwj->hwi", T[:, :3, :3], normals) * seen[..., None]
        images = (np.moveaxis(values, -1, 0).astype(np.float32) for values in (points, normals))
        return SweepImages(*images, (offsets * seen).astype(np.float32), float(_LOW), float(_HIGH))

    def _cast(self, origins: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ranges (H, W), infinite without a hit, and normals (H, W, 3) that face the sensor."""
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = (np.where(rays > 0.0, self.high, self.low) - origins) / rays
            ranges, axis = walls.min(axis=-1), walls.argmin(axis=-1)
            for low, high in self.boxes:
                enter = (np.where(rays > 0.0, low, high) - origins) / rays
                leave = (np.where(rays > 0.0, high, low) - origins) / rays
                first = enter.max(axis=-1)
                nearer = (first > 0.0) & (first < leave.min(axis=-1)) & (first < ranges)
                ranges, axis = np.where(nearer, first, ranges), np.where(nearer, enter.argmax(axis=-1), axis)
        return ranges, -np.sign(rays) * np.eye(3)[axis]

    def scans(self, count: int, twist: Sequence[float], start: FloatArray | None = None) -> list[Scan]:
        """The same as scans stamped at the start of their sweeps, points in the order of time."""
        return self.as_scans(self.sweeps(count, twist, start))

    def as_scans(self, sweeps: list[SweepImages]) -> list[Scan]:
        scans = []
        for number, images in enumerate(sweeps):
            points = images.points.T.reshape(-1, 3)
            offsets = images.offsets.T
            stamp = (number - 0.5) * self.period_s
            rings = np.tile(np.arange(self.rows), self.columns)
            seen = points.any(axis=1)
            times = offsets.reshape(-1) + 0.5 * self.period_s
            scans.append(Scan.from_raw(points[seen], stamp, times[seen], rings[seen]))
        return scans

    def recording(self, count: int, twist: Sequence[float], rolling: bool = True) -> PreparedRecording:
        """The sweeps with their true motions, all valid."""
        T = torch.from_numpy(exp(self.period_s * np.asarray(twist))).float().expand(count - 1, 4, 4)
        periods, valid = torch.full((count - 1,), self.period_s), torch.ones(count - 1, dtype=torch.bool)
        return PreparedRecording(*stacked(self.sweeps(count, twist, rolling=rolling)), periods, T.clone(), valid)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Images here are so small that more threads would mostly wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def box_room() -> Scene:
    """A room of 14 x 10 x 4 m with four boxes in it; no two corners look alike."""
    boxes = (
        ((2.6, 1.6, -1.5), (3.4, 2.4, 2.5)),
        ((-4.6, -3.6, -1.5), (-3.4, -2.4, 0.6)),
        ((-2.3, 3.2, -1.5), (-1.7, 3.8, 2.5)),
        ((4.5, -2.5, -1.5), (5.5, -1.5, 0.3)),
    )
    return Scene((-7.0, -5.0, -1.5), (7.0, 5.0, 2.5), boxes)


@pytest.fixture(scope="session")
def small_room(box_room: Scene) -> Scene:
    """The same with images of 96 columns."""
    return Scene(box_room.low, box_room.high, box_room.boxes, columns=96)


@pytest.fixture(scope="session")
def corridor() -> Scene:
    """Two walls and a floor without end along x."""
    return Scene((-np.inf, -2.0, -1.5), (np.inf, 2.0, np.inf))
