"""The mounting of a LiDAR: a recording in upright axes, by a name or angles, or a guess by the ground in its scans."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, make_transform, principal_axes
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.spin_axis import fibonacci_lattice, image_axes
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import Mounting, MountingName, RollPitchYaw
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.recording import Recording, RecordingInfo

if TYPE_CHECKING:
    from lidarslam.datasets.carrier import Carrier

# Roll, pitch, yaw in degrees of the recorded axes: the direction of the recorded z axis, as seen along x.
_ANGLES_DEG: dict[MountingName, RollPitchYaw] = {
    "upright": (0.0, 0.0, 0.0),
    "upside-down": (180.0, 0.0, 0.0),
    "left": (-90.0, 0.0, 0.0),
    "right": (90.0, 0.0, 0.0),
    "forward": (0.0, 90.0, 0.0),
    "backward": (0.0, -90.0, 0.0),
    "camera": (-90.0, 0.0, -90.0),
}
_SNAPPED = np.cos(np.deg2rad(20.0))
# The calibration of the laser that KITTI was recorded with places every point too low; without the correction the
# average error of KISS-ICP on KITTI doubles. Upwards; the value of KISS-ICP and CT-ICP.
KITTI_DEG = 0.205
# Keeps the division finite for the origin, a driver's mark for "no return", which has to stay the origin.
_SMALLEST_RHO_M = 1e-30
# A plane that faces up within this may be the ground of a sensor that is upright, or held at an angle.
_UPRIGHT = np.cos(np.deg2rad(50.0))
# Ground is taken from planes that face farther from up than this: normals of a few points are off by some degrees.
_TURNED = np.cos(np.deg2rad(60.0))
# No sensor but one that flies is farther above the ground.
_MOST_HEIGHT_M = 4.0
# Ground is seen within this of the spin axis, and the scans agree within as much.
_ALIKE = np.cos(np.deg2rad(25.0))
# A plane opposite with more than this share of the surfaces is a ceiling, or the other wall.
_MOST_OPPOSITE = 0.01
# A sensor that looks farther from its equator than the first on one side and less than the second on the other sees
# the ceiling and not the floor, or the other way round; strays are left out.
_FAR_TO_ONE_SIDE, _NEAR_TO_OTHER, _STRAY_SHARE = np.sin(np.deg2rad(35.0)), np.sin(np.deg2rad(9.0)), 0.005
_SCANS = 5
# Step between the scans that a guess uses.
_STEP = 4
_ENOUGH_SCANS, _SOME_SCANS = 4, 2
# Points farther than this many median ranges are left out; cells are this share of the median range.
_FAR, _CELL_SHARE, _LEAST_CELL_M = 4.0, 1.0 / 30.0, 0.05
_MOST_READ, _MOST_POINTS, _MOST_NORMALS, _NEIGHBOURS = 40_000, 8000, 3000, 10
# Neighbours lie in a plane when the least variance is this share of the next.
_FLAT = 0.05
# A plane's normals are within this of one another, its points within a step of height of one another.
_PARALLEL, _STEP_M = np.cos(np.deg2rad(15.0)), 0.3
_ROUNDS, _SEEDS, _FEWEST = 3, 48, 10
_SECTORS, _IN_SECTOR = 12, 2
# Points this far beneath a plane, and by this share of their range, are beyond it.
_BENEATH_M, _BENEATH_SHARE = 0.5, 0.05


def transform_of(mounting: Mounting) -> FloatArray:
    """T_upright_recorded (4, 4), a rotation; exact of quarter turns, and the identity for `auto`."""
    if mounting == "auto" or mounting == "upright":  # noqa: PLR1714 - mypy narrows by it
        return np.eye(4)
    from scipy.spatial.transform import Rotation  # takes a while to load

    angles = _ANGLES_DEG[mounting] if isinstance(mounting, str) else mounting
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    whole = np.round(R)
    return make_transform(whole if np.abs(R - whole).max() < 1e-12 else R, np.zeros(3))


def corrected(scan: Scan, T_upright_recorded: FloatArray, raised_deg: float, time_scale: float) -> Scan:
    """A scan in upright axes, its points raised above the recorded x-y plane, their times from the stamp scaled."""
    scan = scan.with_times_scaled(time_scale)
    if raised_deg:
        scan = replace(scan, points=correct_elevation(scan.points, raised_deg))
    if np.array_equal(T_upright_recorded, np.eye(4)):
        return scan
    return replace(scan, points=np.ascontiguousarray(scan.points @ T_upright_recorded[:3, :3].T))


def mounting_with_up(up: FloatArray) -> Mounting:
    """The mounting whose upwards direction, a unit vector (3,) in the recorded axes, is this or nearly so.

    It has a name where one is near; the yaw stays open and is small.
    """
    named = {name: transform_of(name)[2, :3] for name in _ANGLES_DEG if name != "camera"}
    for name, direction in named.items():
        if direction @ up > _SNAPPED:
            return name
    roll = float(np.arctan2(up[1], up[2]))
    pitch = float(np.arctan2(-up[0], np.hypot(up[1], up[2])))
    return (float(np.round(np.rad2deg(roll))), float(np.round(np.rad2deg(pitch))), 0.0)


def written(mounting: Mounting) -> str:
    """As the value of `--set reader.mounting=`."""
    return mounting if isinstance(mounting, str) else f"[{','.join(f'{angle:g}' for angle in mounting)}]"


def correct_elevation(points: NDArray[np.floating], angle_deg: float) -> FloatArray:
    """Points (N, 3), invalid ones too, whose elevation as seen from the sensor is raised by the same angle.

    Each point p turns about the axis p x z_hat, which leaves its range and azimuth as they were. With rho the
    horizontal range the turn happens in the (rho, z) plane: rho' = rho cos a - z sin a, z' = rho sin a + z cos a,
    and x and y scale by rho' / rho. The rule, with 0.205 degrees for KITTI, is that of KISS-ICP (Vizzo et al.,
    RA-L 2023) and of CT-ICP and IMLS-SLAM before it.
    """
    corrected, angle = np.empty((len(points), 3)), math.radians(angle_deg)
    _raise(points, math.sin(angle), math.cos(angle), corrected)
    return corrected


@compiled
def _raise(points: NDArray[np.floating], sine: float, cosine: float, corrected: FloatArray) -> None:
    for n in range(len(points)):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        rho = np.sqrt(x * x + y * y)
        scale = cosine - sine * (z / (rho if rho > _SMALLEST_RHO_M else _SMALLEST_RHO_M))
        corrected[n, 0], corrected[n, 1], corrected[n, 2] = x * scale, y * scale, rho * sine + z * cosine


@dataclass(frozen=True)
class Guess:
    """The mounting as the first scans show it."""

    mounting: Mounting = "upright"  # that is applied
    warning: str | None = None  # the guess, or that it cannot be decided; with the setting


UPRIGHT = Guess()


class MountedRecording:
    """A recording whose LiDAR frame is turned to x forward, z up: scans, corrected too, ground truth and extrinsics.

    A mounting `auto` is guessed from the first scans, and the carrier found, when they are needed.
    """

    def __init__(
        self,
        recorded: Recording,
        mounting: Mounting,
        raised_deg: float = 0.0,
        time_scale: float = 1.0,
        *,
        remove_carrier: bool = False,
    ) -> None:
        self.recorded = recorded
        self.raised_deg = raised_deg
        self._time_scale = time_scale
        self._mounting = mounting
        self._remove_carrier = remove_carrier

    @cached_property
    def _guess(self) -> Guess:
        if self._mounting != "auto":
            return Guess(self._mounting)
        try:
            return guess_mounting(scan.points for scan in self.recorded.scans(step=_STEP, faults=Faults()))
        except InputError:  # raised again when the scans are read
            return UPRIGHT

    @cached_property
    def _carrier(self) -> "Carrier | None":
        if not self._remove_carrier:
            return None
        from lidarslam.datasets.carrier import carrier_in, sampled  # takes a while to load

        try:
            return carrier_in(self._upright(scan).points for scan in sampled(self.recorded))
        except InputError:  # raised again when the scans are read
            return None

    @cached_property
    def T_upright_recorded(self) -> FloatArray:
        """(4, 4) the rotation from the recorded axes."""
        return transform_of(self._guess.mounting)

    @property
    def name(self) -> str:
        """A short name."""
        return self.recorded.name

    def __len__(self) -> int:
        return len(self.recorded)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar, of the upright axes; the world is the truth's."""
        truth = self.recorded.ground_truth
        if truth is None:
            return None
        return Trajectory(truth.stamps, truth.T_world_lidar @ inverse(self.T_upright_recorded))

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """Extrinsic calibration of a KITTI recording."""
        T_cam_recorded = self.recorded.T_cam_lidar
        return None if T_cam_recorded is None else np.asarray(T_cam_recorded @ inverse(self.T_upright_recorded))

    @property
    def imu(self) -> ImuSamples | None:
        """The samples of the IMU, with its extrinsic calibration to the upright axes."""
        samples = self.recorded.imu
        if samples is None or samples.T_lidar_imu is None:
            return samples
        return replace(samples, T_lidar_imu=self.T_upright_recorded @ samples.T_lidar_imu)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Of the recording, of a guess, and of a carrier."""
        found = self._guess.warning, None if self._carrier is None else self._carrier.warning
        return (*self.recorded.warnings, *(warning for warning in found if warning is not None))

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`, in upright axes, without the carrier."""
        carrier = self._carrier  # found before the first scan: two passes over one file may not alternate
        scans = map(self._upright, self.recorded.scans(start, stop, step, faults))
        return scans if carrier is None else map(carrier.remove, scans)

    def _upright(self, scan: Scan) -> Scan:
        return corrected(scan, self.T_upright_recorded, self.raised_deg, self._time_scale)

    def describe(self) -> RecordingInfo:
        """The contents of the recording, and its mounting unless it is upright."""
        info, guess, notes = self.recorded.describe(), self._guess, []
        if guess.warning is not None:
            notes.append(_sentence(guess.warning))
        elif not np.array_equal(self.T_upright_recorded, np.eye(4)):
            notes.append(f"The scans are turned upright, as reader.mounting={written(guess.mounting)}.")
        if self.raised_deg:
            notes.append(
                f"Every point is raised by {self.raised_deg:g} degrees of elevation, before every method alike."
            )
        if self._carrier is not None:
            notes.append(_sentence(self._carrier.warning))
        return replace(info, first=self._upright(info.first), notes=(*info.notes, *notes))


def _sentence(warning: str) -> str:
    return f"{warning[0].upper()}{warning[1:]}."


def recorded_axes(recording: Recording) -> tuple[Recording, FloatArray]:
    """The recording in its own axes as its reader opened it, and T_upright_recorded (4, 4)."""
    if isinstance(recording, MountedRecording):
        return recording.recorded, recording.T_upright_recorded
    return recording, np.eye(4)


def elevation_of(recording: Recording) -> tuple[float, float]:
    """The degrees by which a recording's points are raised, and the cosine between its recorded z axis and up."""
    if not isinstance(recording, MountedRecording):
        return 0.0, 1.0
    return recording.raised_deg, float(recording.T_upright_recorded[2, 2])


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane that the sensor sees from one side."""

    up: FloatArray  # (3,) unit normal towards the sensor
    height_m: float  # of the sensor above it
    share: float  # of the scan's surfaces
    sectors: int  # of 12 around the normal, in which it was seen
    beyond: float  # share of the points that are beyond it


def planes(points: FloatArray) -> list[Plane]:
    """The planes in a scan (N, 3), one for each direction of their normals, the largest first."""
    thinned, on, normals = _normals(points)
    if len(normals) < _FEWEST:
        return []
    spread = fibonacci_lattice(1.0 - 2.0 * (np.arange(_SEEDS) + 0.5) / _SEEDS)
    seeds = np.concatenate([np.eye(3), -np.eye(3), spread])
    found: list[Plane] = []
    for seed in seeds[np.argsort(-(normals @ seeds.T > _PARALLEL).sum(axis=0), kind="stable")]:
        plane = _plane(seed, thinned, on, normals)
        if plane is not None and not any(plane.up @ other.up > _PARALLEL for other in found):
            found.append(plane)
    return sorted(found, key=lambda plane: -plane.share)


def _plane(up: FloatArray, thinned: FloatArray, on: FloatArray, normals: FloatArray) -> Plane | None:
    """The plane with the most of the surfaces `on` (M, 3) whose normals (M, 3) are near a direction (3,)."""
    chosen = np.zeros(len(normals), dtype=np.bool_)
    for _ in range(_ROUNDS):
        near = np.flatnonzero(normals @ up > _PARALLEL)
        heights = -(on[near] @ up)
        near, heights = near[heights > 0.0], heights[heights > 0.0]
        if len(near) < _FEWEST:
            return None
        bins = (heights / _STEP_M).astype(np.intp)
        counts = np.bincount(bins, minlength=2)
        lower = int(np.argmax(counts[:-1] + counts[1:]))
        chosen = near[(bins == lower) | (bins == lower + 1)]
        up = normals[chosen].mean(axis=0)
        up = up / np.linalg.norm(up)
    height_m = float(np.median(-(on[chosen] @ up)))
    across = np.linalg.svd(up[None])[2][1:]
    x, y = across @ on[chosen].T
    sectors = np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.intp) % _SECTORS
    seen = int((np.bincount(sectors, minlength=_SECTORS) >= _IN_SECTOR).sum())
    beneath = -(thinned @ up) > height_m + _BENEATH_M + _BENEATH_SHARE * np.linalg.norm(thinned, axis=1)
    return Plane(up, height_m, len(chosen) / len(normals), seen, float(beneath.mean()))


def _normals(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The thinned points (K, 3), some of them (M, 3) that lie on surfaces, and normals there (M, 3) to the sensor."""
    from scipy.spatial import cKDTree  # takes a while to load

    empty = np.empty((0, 3))
    few = points[:: max(1, len(points) // _MOST_READ)]
    ranges = np.linalg.norm(few, axis=1)
    if len(few) < _FEWEST:
        return empty, empty, empty
    median_m = float(np.median(ranges))
    cell_m = max(_LEAST_CELL_M, _CELL_SHARE * median_m)
    near = np.ascontiguousarray(few[ranges < _FAR * median_m])
    thinned = near[one_per_cell(near, cell_m)]
    thinned = thinned[:: -(-len(thinned) // _MOST_POINTS)]
    if len(thinned) < _NEIGHBOURS:
        return thinned, empty, empty
    asked = thinned[:: -(-len(thinned) // _MOST_NORMALS)]
    found = cKDTree(thinned).query(asked, k=_NEIGHBOURS)
    distances, index = np.asarray(found[0]), np.asarray(found[1])
    index = index[distances[:, -1] < 6.0 * cell_m]
    means, variances, axes = principal_axes(thinned[index])
    flat = variances[:, 0] < _FLAT * variances[:, 1]
    on, normals = means[flat], axes[flat, :, 0]
    return thinned, on, normals * -np.sign(np.einsum("ni,ni->n", normals, on))[:, None]


def guess_mounting(scans: Iterable[FloatArray]) -> Guess:
    """The guess from the points (N, 3) of scans, of which no more are read than needed."""
    found: list[FloatArray] = []
    unclear: list[FloatArray] = []
    for number, points in enumerate(scans):
        if number == _SCANS:
            break
        up, axis = _upwards(points)
        if up is not None:
            found.append(up)
        elif axis is not None:
            unclear.append(axis)
        if number == 0 and not found and not unclear:
            return UPRIGHT
    return _decide(found, unclear)


def _decide(found: Sequence[FloatArray], unclear: Sequence[FloatArray]) -> Guess:
    mean = np.sum(found, axis=0) if found else np.zeros(3)
    agreeing = [up for up in found if up @ mean > _ALIKE * np.linalg.norm(mean)]
    if len(agreeing) >= _SOME_SCANS:
        up = np.sum(agreeing, axis=0)
        mounting = mounting_with_up(up / np.linalg.norm(up))
        setting = f"--set reader.mounting={written(mounting)}"
        if len(agreeing) >= _ENOUGH_SCANS:
            return Guess(
                mounting,
                f"the ground in the first scans shows that z is not up; taken as {setting}, which makes this certain"
                " (--set reader.mounting=upright leaves the scans as they are)",
            )
        return Guess(warning=f"z may not be up in this recording; if so, use {setting}")
    if len(unclear) >= _ENOUGH_SCANS:
        ways = " or ".join(written(mounting_with_up(sign * unclear[0])) for sign in (1.0, -1.0))
        return Guess(
            warning="the scans were not taken about the z axis, and no ground shows which way is up; if it is not z,"
            f" use --set reader.mounting={ways}"
        )
    return UPRIGHT


def _upwards(points: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
    """The upwards direction (3,), if it is far from z and clear; and the spin axis (3,) if z is neither."""
    seen = planes(points)
    if not seen or any(_may_be_upright(plane, None) for plane in seen if plane.height_m < _MOST_HEIGHT_M):
        return None, None
    R_image_recorded = image_axes(points)
    if _sees_one_side(points, R_image_recorded[2]):
        return None, None
    axis = None if np.array_equal(R_image_recorded, np.eye(3)) else R_image_recorded[2]
    # Next to the spin axis a wall is like the ground of a sensor on its side.
    across = [plane for plane in seen if abs(plane.up @ R_image_recorded[2]) > _UPRIGHT]
    grounds = [plane for plane in across if plane.up[2] < _TURNED and _is_ground(plane, seen, axis)]
    largest = max(grounds, key=lambda plane: plane.share, default=None)
    if any(_may_be_upright(plane, largest) for plane in seen):
        return None, None
    if largest is not None:
        return largest.up, axis
    return None, axis if axis is not None and abs(axis[2]) < _TURNED else None


def _sees_one_side(points: FloatArray, axis: FloatArray) -> bool:
    """Whether points (N, 3) lie far to one side of the equator of an axis (3,), and hardly any to the other."""
    ranges = np.linalg.norm(points, axis=1)
    usable = ranges > 0.0
    low, high = np.quantile(points[usable] @ axis / ranges[usable], [_STRAY_SHARE, 1.0 - _STRAY_SHARE])
    return bool(min(-low, high) < _NEAR_TO_OTHER and max(-low, high) > _FAR_TO_ONE_SIDE)


def _is_ground(plane: Plane, seen: Sequence[Plane], axis: FloatArray | None) -> bool:
    """Whether a plane is certainly the ground; the criterion is weaker for one that the sensor spins parallel to."""
    if plane.height_m > _MOST_HEIGHT_M:
        return False
    opposite = max((other.share for other in seen if other.up @ plane.up < -_ALIKE), default=0.0)
    if axis is not None and abs(plane.up @ axis) > _ALIKE:
        is_alone = opposite < 0.25 * plane.share
        return plane.share > 0.03 and plane.sectors >= 6 and plane.beyond < 0.02 and is_alone
    is_alone = opposite < _MOST_OPPOSITE
    return plane.share > 0.08 and plane.sectors >= 9 and plane.beyond < 0.01 and is_alone


def _may_be_upright(plane: Plane, ground: Plane | None) -> bool:
    """Whether a plane that faces up may be the ground, so that the recording is upright."""
    if plane.up[2] < _UPRIGHT or plane.share < 0.01 or plane.sectors < 4:
        return False
    if plane.height_m < _MOST_HEIGHT_M:
        return plane.beyond < 0.03 or (ground is not None and plane.share > 0.25 * ground.share)
    return plane.beyond < 0.01 and (ground is None or plane.share > ground.share)
