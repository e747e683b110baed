"""Alignment of a trajectory with a GNSS track: where the world of a run lies on the Earth; positions for its graph."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, skew
from lidarslam.core.trajectory import Trajectory

# Prior standard deviation of the tilt of the world's z axis, which positions on a straight line leave open.
_TILT = float(np.deg2rad(5.0))
_ITERATIONS = 30
# Of the scale of the residuals: of the median of |N(0, 1)|, a floor in metres, and Cauchy's weights.
_MAD, _LEAST_SCALE_M, _CAUCHY = 1.4826, 0.01, 2.385
_FEWEST = 5
# Errors of GNSS are correlated over this time, seconds: positions within it count as one.
_CORRELATED_S = 10.0
# Standard deviations, metres: where none is stated, and at least. That of the height is larger by the factor.
_UNKNOWN_M, _LEAST_GNSS_M, _HEIGHT = 3.0, 0.02, 2.0


class TooFewPositionsError(ValueError):
    """Too few GNSS positions are within the time of a trajectory."""


@dataclass(frozen=True, eq=False)
class GnssTrack:
    """Positions of an antenna."""

    stamps: FloatArray  # (N,) seconds, on the clock of the scans
    geodetic: FloatArray  # (N, 3) latitude and longitude in degrees, altitude in metres (WGS 84)
    sigma_m: FloatArray  # (N,) horizontal standard deviation as stated; NaN where unknown
    lidar_antenna: FloatArray  # (3,) position of the antenna in the LiDAR frame
    notes: tuple[str, ...] = ()  # remarks, a sentence each

    def is_within(self, trajectory: Trajectory, projected: FloatArray) -> NDArray[np.bool_]:
        """(N,) which positions are within the time of a trajectory, and finite in the projection (N, 3)."""
        times = trajectory.stamps
        during = (self.stamps >= times[0]) & (self.stamps <= times[-1])
        return np.asarray(during & np.isfinite(projected).all(axis=1))


@dataclass(frozen=True, eq=False)
class Georeference:
    """The world of a run in a map projection; `p_map = scale * R @ p_world + t`."""

    T_map_world: FloatArray  # (4, 4) rotation and translation; x east, y north, z up
    scale: float  # of the projection at this place
    matched: int  # GNSS positions that were used
    rms_m: float  # residuals of these, all of them
    median_m: float
    heading_sigma_deg: float  # a bound of the error of the heading

    def positions(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) of the world in the projection."""
        return self.scale * points @ self.T_map_world[:3, :3].T + self.T_map_world[:3, 3]


def align_to_track(trajectory: Trajectory, track: GnssTrack, projected: FloatArray, scale: float) -> Georeference:
    """Robust rigid alignment of a trajectory with a GNSS track, whose positions are projected (N, 3) at a scale.

    Minimises Cauchy's loss of the distances between the antenna on the trajectory and its measured positions. The tilt
    of the world has a weak prior, as positions on a straight line do not determine the rotation about it. A
    TooFewPositionsError is raised where fewer than five are within the time of the trajectory.
    """
    from scipy.spatial.transform import Rotation  # takes a while to load

    within = track.is_within(trajectory, projected)
    if within.sum() < _FEWEST:
        count = int(within.sum())
        raise TooFewPositionsError(f"{count} GNSS positions are within the time of the run, expected {_FEWEST} or more")
    poses = trajectory.at(track.stamps[within])
    measured = projected[within]
    antenna = scale * (poses[:, :3, :3] @ track.lidar_antenna + poses[:, :3, 3])
    middle, centre = measured.mean(axis=0), antenna.mean(axis=0)
    y, x = measured - middle, antenna - centre
    # The heading that aligns the centred positions best.
    heading = np.arctan2((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum(), (x[:, :2] * y[:, :2]).sum())
    T = make_transform(Rotation.from_euler("z", heading).as_matrix(), np.zeros(3))
    sigma = track.sigma_m[within]
    stated = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 0.0
    for _ in range(_ITERATIONS):
        change = _step(T, x, y)
        T = T @ exp(change)
        if np.linalg.norm(change) < 1e-10:
            break
    errors = np.linalg.norm(y - (x @ T[:3, :3].T + T[:3, 3]), axis=1)
    spread = float(np.sqrt((x[:, :2] ** 2).sum(axis=1).mean()))
    # Errors of GNSS are correlated in time: they do not average out over the track.
    uncertain = max(stated, float(np.median(errors)), _LEAST_SCALE_M)
    R = T[:3, :3]
    return Georeference(
        T_map_world=make_transform(R, T[:3, 3] + middle - R @ centre),
        scale=scale,
        matched=int(within.sum()),
        rms_m=float(np.sqrt((errors**2).mean())),
        median_m=float(np.median(errors)),
        heading_sigma_deg=float(np.rad2deg(np.arctan2(uncertain, spread))),
    )


def _step(T: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """One reweighted Gauss-Newton step (6,), rotation first, to be multiplied from the right."""
    R = T[:3, :3]
    residuals = y - (x @ R.T + T[:3, 3])
    errors = np.linalg.norm(residuals, axis=1)
    scale = max(_LEAST_SCALE_M, _MAD * float(np.median(errors)))
    weights = 1.0 / (scale**2 * (1.0 + (errors / (_CAUCHY * scale)) ** 2))
    J = np.concatenate([-R @ skew(x), np.tile(R, (len(x), 1, 1))], axis=2)
    H = np.einsum("n,nij,nik->jk", weights, J, J)
    b = np.einsum("n,nij,ni->j", weights, J, residuals)
    # The prior: R z is up, a vector whose horizontal part is the tilt; d(R z) = R (d x z) = -R [z] d.
    tilt = (R @ np.array([0.0, 0.0, 1.0]))[:2]
    J_tilt = np.zeros((2, 6))
    J_tilt[:, :3] = -(R @ skew(np.array([0.0, 0.0, 1.0])))[:2]
    H += J_tilt.T @ J_tilt / _TILT**2
    b -= J_tilt.T @ tilt / _TILT**2
    return np.asarray(np.linalg.solve(H, b), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class AntennaPosition:
    """A measured position, assigned to the keyframe nearest in time."""

    key: int
    antenna: FloatArray  # (3,) in the keyframe's LiDAR frame, by the registered motion between both
    measured: FloatArray  # (3,) x east, y north, z up, metres
    sigmas: FloatArray  # (3,) metres
    repeats: float  # number of positions whose errors are correlated


@dataclass(frozen=True, eq=False)
class ProjectedTrack:
    """A GNSS track in a map projection."""

    track: GnssTrack
    projected: FloatArray  # (N, 3) metres
    scale: float  # of the projection at this place

    def aligned(self, trajectory: Trajectory) -> FloatArray:
        """T_map_world (4, 4) of a trajectory; the origin of the map is the first position."""
        T = align_to_track(trajectory, self.track, self.projected - self.projected[0], self.scale).T_map_world.copy()
        T[:3, 3] /= self.scale
        return T

    def positions(self, trajectory: Trajectory, keyframe_scans: Sequence[int]) -> list[AntennaPosition]:
        """The positions within the time of a trajectory (M poses), assigned to the keyframes among its scans."""
        track, scans = self.track, np.asarray(keyframe_scans)
        rows = np.flatnonzero(track.is_within(trajectory, self.projected))
        between = trajectory.stamps[scans[:-1]] + 0.5 * np.diff(trajectory.stamps[scans])
        keys = np.searchsorted(between, track.stamps[rows])
        antennas = trajectory.at(track.stamps[rows]) @ np.append(track.lidar_antenna, 1.0)
        T_keyframe_world = inverse(trajectory.T_world_lidar[scans[keys]])
        antennas = np.einsum("nij,nj->ni", T_keyframe_world, antennas)[:, :3]
        measured = (self.projected[rows] - self.projected[0]) / self.scale
        repeats = max(1.0, len(rows) * _CORRELATED_S / max(float(np.ptp(track.stamps[rows])), _CORRELATED_S))
        stated = np.where(np.isfinite(track.sigma_m[rows]), track.sigma_m[rows], _UNKNOWN_M)
        sigmas = np.maximum(stated, _LEAST_GNSS_M)[:, None] * np.array([1.0, 1.0, _HEIGHT])
        return [
            AntennaPosition(int(key), antenna, position, sigma, repeats)
            for key, antenna, position, sigma in zip(keys, antennas, measured, sigmas, strict=True)
        ]
