"""Measurements of an inertial measurement unit (IMU)."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray

# Median of the specific force's size, m/s^2: a carried sensor measures gravity on average.
GRAVITY_RANGE = (7.0, 15.0)


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """All samples of one recording, in the IMU's own frame, on the clock of the scans' stamps."""

    stamps: FloatArray  # (N,) seconds, strictly increasing
    angular_velocities: FloatArray  # (N, 3) rad/s, with the gyroscope's bias
    accelerations: FloatArray  # (N, 3) specific force, m/s^2: about +9.8 along the axis that points up at rest
    T_lidar_imu: FloatArray | None = None  # (4, 4) extrinsic calibration; None where the recording has none
    notes: tuple[str, ...] = ()  # inferences about them and repairs, one sentence each

    def __post_init__(self) -> None:
        expected = (len(self.stamps), 3)
        for name in ("angular_velocities", "accelerations"):
            if (shape := getattr(self, name).shape) != expected:
                raise ValueError(f"ImuSamples.{name} must be {expected}, got {shape}")
        if len(self.stamps) and not (np.diff(self.stamps) > 0.0).all():
            raise ValueError("ImuSamples.stamps must increase")

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def rate_hz(self) -> float | None:
        """Median rate; None of fewer than two samples."""
        return 1.0 / float(np.median(np.diff(self.stamps))) if len(self) > 1 else None
