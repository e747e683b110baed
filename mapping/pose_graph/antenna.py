"""Positions of a GNSS antenna, which hold the graph on the Earth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.products.georeference import GnssTrack, align_to_track

# Errors of GNSS are correlated over this time, seconds: positions within it count as one.
_CORRELATED_S = 10.0
# Standard deviations, metres: where none is stated, and at least. That of the height is larger by the factor.
_UNKNOWN_M, _LEAST_M, _HEIGHT = 3.0, 0.02, 2.0


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
        """T_map_world (4, 4) of a trajectory; the origin of the map is the first position.

        Raises:
            TooFewPositionsError: too few positions are within its time.
        """
        T = align_to_track(trajectory, self.track, self.projected - self.projected[0], self.scale).T_map_world.copy()
        T[:3, 3] /= self.scale
        return T

    def positions(self, trajectory: Trajectory, keyframe_scans: Sequence[int]) -> list[AntennaPosition]:
        """The positions within the time of a trajectory (M poses), assigned to the keyframes among its scans."""
        stamps, track = trajectory.stamps, self.track
        rows = np.flatnonzero(track.is_within(trajectory, self.projected))
        if not len(rows):
            return []
        scans = np.asarray(keyframe_scans)
        keys = np.abs(stamps[scans][None, :] - track.stamps[rows, None]).argmin(axis=1)
        antennas = trajectory.at(track.stamps[rows]) @ np.append(track.lidar_antenna, 1.0)
        T_keyframe_world = inverse(trajectory.T_world_lidar[scans[keys]])
        antennas = np.einsum("nij,nj->ni", T_keyframe_world, antennas)[:, :3]
        measured = (self.projected[rows] - self.projected[0]) / self.scale
        repeats = max(1.0, len(rows) * _CORRELATED_S / max(float(np.ptp(track.stamps[rows])), _CORRELATED_S))
        stated = np.where(np.isfinite(track.sigma_m[rows]), track.sigma_m[rows], _UNKNOWN_M)
        sigmas = np.maximum(stated, _LEAST_M)[:, None] * np.array([1.0, 1.0, _HEIGHT])
        return [
            AntennaPosition(int(key), antenna, position, sigma, repeats)
            for key, antenna, position, sigma in zip(keys, antennas, measured, sigmas, strict=True)
        ]
