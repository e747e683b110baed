"""The result of registering one scan."""

from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.pipeline.estimates import Localised


@dataclass(frozen=True, eq=False)
class RegisteredScan:
    """The pose of a scan as estimated when it came, and its quality; arrays are read-only."""

    stamp: float  # seconds
    T_world_lidar: FloatArray  # (4, 4) at the stamp; the world is the LiDAR frame of the first scan
    # whether no later scan changes the pose: without a pose graph, whose loops correct the earlier ones
    is_final: bool
    # status, message: ok, degraded or lost, and the reason unless it is ok; the pose of a lost scan is a prediction
    status: Status
    message: str
    # (6, 6) of the error `xi` in `T_true = T_world_lidar @ exp(xi)`, rotation first, radians and metres; None where the
    # scan was not registered to a map
    covariance: FloatArray | None
    degenerate: tuple[str, ...]  # of roll, pitch, yaw, x, y, z of the LiDAR: those that the scan does not constrain
    velocity: FloatArray | None  # (6,) of the LiDAR in its own frame, rotation first, rad/s and m/s; None where unknown
    points_used: int  # number of correspondences
    # residual_m, inlier_ratio: of the fit to the map or the previous scan; None when it could not be computed
    residual_m: float | None
    inlier_ratio: float | None

    @classmethod
    def of(cls, stamp: float, localised: Localised, is_final: bool) -> "RegisteredScan":
        """Of a scan's pose."""
        return cls(
            stamp=stamp,
            is_final=is_final,
            T_world_lidar=_read_only(localised.T_world_lidar),
            status=localised.status,
            message=localised.message,
            covariance=None if localised.covariance is None else _read_only(localised.covariance),
            degenerate=localised.degenerate,
            velocity=None if (velocity := localised.motion.latest) is None else _read_only(velocity),
            points_used=localised.points_used,
            residual_m=localised.residual_m,
            inlier_ratio=localised.inlier_ratio,
        )


def _read_only(array: FloatArray) -> FloatArray:
    """A copy that the caller cannot change: the next scan's estimate begins with the original."""
    copy = array.copy()
    copy.flags.writeable = False
    return copy
