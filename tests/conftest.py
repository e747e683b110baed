"""Shared fixtures: random numbers, real recordings, and a room whose scans are known exactly."""

import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import HealthCheck, settings

from lidarslam.config.settings import Config, dump_yaml
from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import Scan
from lidarslam.core.state import State, read_state, write_state
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud

# The benchmarks are scripts that import one another from their own folder.
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

# Hints name a program by its path unless the shell finds it.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])

# The first call of a compiled loop takes as long as compiling it.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

Drive = Callable[[FloatArray], FloatArray]


def fuzzed(examples: int) -> settings:
    """Examples that follow from the test's name alone, so that a failure is found again."""
    unimportant = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    return settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=unimportant)


def lidarslam(*arguments: object) -> Result:
    """A command, carried out in this process."""
    from lidarslam.cli import main

    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


def succeeds(*arguments: object) -> str:
    """What a command says that ends with exit status 0."""
    result = lidarslam(*arguments)
    assert result.exit_code == 0, result.output
    return str(result.output)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(2021)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C works in this process and its children, even where the tests were started with it ignored (nohup)."""
    earlier = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, earlier)


@pytest.fixture
def still_runs() -> Callable[[int], bool]:
    """Whether a process is alive, by its number, after a moment to end."""

    def still_runs(pid: int) -> bool:
        for _ in range(100):
            try:
                state = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[0]
            except FileNotFoundError:
                return False
            if state == b"Z":
                return False
            time.sleep(0.05)
        return True

    return still_runs


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder with unpacked real recordings, named by LIDARSLAM_TEST_DATA."""
    folder = os.environ.get("LIDARSLAM_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("set LIDARSLAM_TEST_DATA to the folder with kitti_odometry_04 and kitti_raw_0005")
    return Path(folder)


@dataclass(frozen=True)
class Room:
    """A box of 14 x 10 x 4 m with four pillars, scanned without noise at 10 Hz.

    The scanner turns once a sweep and looks up and down at random: rings would repeat with every sweep, and methods
    that match points to points stick to them.
    """

    half_size: tuple[float, float, float] = (7.0, 5.0, 2.0)
    pillars: tuple[tuple[float, float, float], ...] = ((3, 2, 0.4), (-4, -3, 0.6), (-2, 3.5, 0.3), (5, -2, 0.5))
    points: int = 9_000
    period_s: float = 0.1

    def directions(self, seed: int) -> tuple[FloatArray, FloatArray]:
        """Unit directions (N, 3) of one sweep and the fraction (N,) of the sweep each is measured at."""
        rng = np.random.default_rng(seed)
        fraction = np.sort(rng.uniform(0.0, 1.0, self.points))
        elevation, azimuth = np.deg2rad(rng.uniform(-30.0, 30.0, self.points)), np.pi - 2.0 * np.pi * fraction
        rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        return np.stack(rays, axis=-1), fraction

    def cast(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Distance (N,) along each ray (N, 3) to the first wall or pillar."""
        with np.errstate(divide="ignore"):
            inverse = 1.0 / np.where(directions == 0.0, 1e-12, directions)
        walls = np.array(self.half_size)
        distance = ((np.sign(directions) * walls - origins) * inverse).min(axis=1)
        for x, y, half in self.pillars:
            near = (np.array([x - half, y - half, -walls[2]]) - origins) * inverse
            far = (np.array([x + half, y + half, walls[2]]) - origins) * inverse
            enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
            distance = np.where((enter < leave) & (enter > 0.0), np.minimum(distance, enter), distance)
        return distance

    def distance_to_surface(self, points: FloatArray) -> FloatArray:
        """Distance (N,) of points (N, 3) to the nearest wall or pillar."""
        distance = np.abs(np.abs(points) - self.half_size).min(axis=1)
        for x, y, half in self.pillars:
            outside = np.abs(points[:, :2] - [x, y]) - half
            beside = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0)
            distance = np.minimum(distance, np.abs(beside))
        return distance

    def sweep(self, T_room_lidar_at: Drive, stamp: float, stamp_at: float = 0.5) -> Scan:
        """A rolling sweep: every ray is cast from the pose (N, 4, 4) at its own time (N,).

        `stamp_at` says where in the sweep the stamp lies: 0 at its start, 1 at its end.
        """
        directions, fraction = self.directions(seed=round(1e3 * stamp))
        offsets = (fraction - stamp_at) * self.period_s
        return Scan.from_raw(self._measured(T_room_lidar_at, directions, stamp + offsets), stamp, offsets)

    def ring_sweep(self, T_room_lidar_at: Drive, stamp: float, rings: int = 32, columns: int = 480) -> Scan:
        """A sweep of a scanner with rings, column after column, clockwise from behind, stamped in its middle."""
        offsets = ((np.arange(columns) + 0.5) / columns - 0.5).repeat(rings)
        elevation, azimuth = np.tile(np.deg2rad(np.linspace(-28.0, 28.0, rings)), columns), -2.0 * np.pi * offsets
        rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        times = self.period_s * offsets
        points = self._measured(T_room_lidar_at, np.stack(rays, axis=-1), stamp + times)
        return Scan.from_raw(points, stamp, times, np.tile(np.arange(rings), columns))

    def _measured(self, T_room_lidar_at: Drive, directions: FloatArray, times: FloatArray) -> FloatArray:
        """Points (N, 3) along directions (N, 3) of the LiDAR frame, each from the pose at its own time (N,)."""
        T = T_room_lidar_at(times)
        ranges = self.cast(T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], directions))
        return directions * ranges[:, None]


def write_recording(folder: Path, scans: Iterable[Scan], truth: Trajectory | None = None, is_timed=False) -> Path:
    """Scans as .npy files, on request with times and rings of their points; their stamps, and the ground truth."""
    folder.mkdir()
    stamps = []
    for index, scan in enumerate(scans):
        columns = dict(zip("xyz", scan.points.T, strict=True)) | {"time": scan.time_offsets, "ring": scan.rings}
        columns = {name: values for name, values in columns.items() if values is not None}
        table = np.empty(len(scan), dtype=[(name, values.dtype) for name, values in columns.items()])
        for name, values in columns.items():
            table[name] = values
        np.save(folder / f"{index:06d}.npy", table if is_timed else scan.points)
        stamps.append(scan.stamp)
    np.savetxt(folder / "timestamps.txt", stamps, fmt="%.9f")
    if truth is not None:
        truth.save(folder / "ground_truth.tum")
    return folder


def write_run(folder: Path, trajectory: Trajectory, cloud: PointCloud | None = None, **about: object) -> Path:
    """A run directory with these results, and what its configuration says of it."""
    folder.mkdir(exist_ok=True)
    trajectory.save(folder / "trajectory.tum")
    if cloud is not None:
        write_cloud(folder / "map.ply", cloud)
    if about:
        (folder / "config.yaml").write_text(dump_yaml(Config(), about))
    return folder


@pytest.fixture(scope="session")
def room() -> Room:
    return Room()


@pytest.fixture(scope="session")
def uneven_room(room: Room) -> Room:
    """A room that does not look alike after half a turn."""
    return Room(pillars=(*room.pillars, (5.3, 3.3, 1.5), (-1.0, -4.0, 0.9)))


@pytest.fixture(scope="session")
def drive() -> Drive:
    """A smooth path through the room: poses (N, 4, 4) at times (N,); about 0.8 m/s, turning 17 degrees a second."""

    def T_room_lidar_at(time: FloatArray) -> FloatArray:
        start = exp([0.0, 0.0, 0.3, -4.0, 0.0, -0.4])
        return start @ exp(np.multiply.outer(np.asarray(time), [0.0, 0.01, 0.3, 0.8, 0.05, 0.0]))

    return T_room_lidar_at


@pytest.fixture(scope="session")
def room_truth(drive: Drive) -> Trajectory:
    """The true poses at the stamps of `room_scans`."""
    stamps = 0.1 * np.arange(1, 21)
    return Trajectory(stamps, drive(stamps))


@pytest.fixture(scope="session")
def room_scans(room: Room, drive: Drive, room_truth: Trajectory) -> list[Scan]:
    """Twenty rolling sweeps along the drive, stamped in their middle."""
    return [room.sweep(drive, float(stamp)) for stamp in room_truth.stamps]


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan], room_truth: Trajectory) -> Path:
    """Five scans with ground truth, not to be written to."""
    return write_recording(tmp_path_factory.mktemp("recordings") / "room", room_scans[:5], room_truth)


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, and nothing is in it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def through_disk(tmp_path: Path) -> Callable[[State], State]:
    return lambda state: (write_state(tmp_path / "state.npz", state), read_state(tmp_path / "state.npz"))[1]
