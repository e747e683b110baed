"""Poses of a live run for the robot: odometry and the transform of its frame."""

from collections.abc import Callable

from lidarslam.core.geometry import FloatArray, adjoint, inverse
from lidarslam.core.tracking import Status
from lidarslam.pipeline.estimates import Localised
from lidarslam.run.modes.live.messages import serialize_odometry, serialize_transform

Publish = Callable[[bytes], None]


class PosePublisher:
    """Publishes the pose of a body that carries the LiDAR, relative to where the body stood at the first scan.

    The pose of a lost scan is a prediction, and is not published.

    Args:
        odometry: publishes a nav_msgs/Odometry.
        transforms: publishes a tf2_msgs/TFMessage; None: no transforms.
        fixed_frame, body_frame: the names of the frames.
        T_body_lidar: (4, 4) the pose of the LiDAR on the body.
    """

    def __init__(
        self,
        odometry: Publish,
        transforms: Publish | None,
        fixed_frame: str,
        body_frame: str,
        T_body_lidar: FloatArray,
    ) -> None:
        self._odometry, self._transforms = odometry, transforms
        self._frames = (fixed_frame, body_frame)
        self._T_body_lidar = T_body_lidar
        self._adjoint = adjoint(T_body_lidar)

    def publish(self, stamp_ns: int, localised: Localised) -> None:
        """Publish the pose of a scan."""
        if localised.status is Status.LOST:
            return
        # With A the adjoint of T_body_lidar, an error or velocity xi of the LiDAR is A xi of the body.
        T, A = self._T_body_lidar @ localised.T_world_lidar @ inverse(self._T_body_lidar), self._adjoint
        covariance = None if localised.covariance is None else A @ localised.covariance @ A.T
        velocity = None if (latest := localised.motion.latest) is None else A @ latest
        self._odometry(serialize_odometry(stamp_ns, *self._frames, T, covariance, velocity))
        if self._transforms is not None:
            self._transforms(serialize_transform(stamp_ns, *self._frames, T))
