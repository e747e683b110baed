"""The error of a sensor's elevations: its estimate by a run, and its correction beforehand."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.mounting import elevation_of
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.elevation import ElevationEstimator
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.run.request import RunRequest

# An error is certain beyond this many standard deviations.
_CERTAIN_SIGMAS = 4.0
# The elevations of a sensor whose recorded z axis is farther from up or down than this are about another axis.
_UPRIGHT = 0.999
# Scans that are registered beforehand, at most; fewer where the error is known well enough before.
_MOST_SCANS, _ENOUGH_STRETCHES = 300, 3


@dataclass(frozen=True)
class Elevation:
    """The degrees by which the points of a recording have to be raised, and were."""

    elevation_bias_deg: float
    elevation_sigma_deg: float  # standard deviation of the bias
    elevation_correction_deg: float  # by which they were raised

    @classmethod
    def found(cls, recording: Recording, estimator: ElevationEstimator) -> "Elevation | None":
        """The result of an estimator on a recording's scans."""
        raised_deg, upwards = elevation_of(recording)
        bias = estimator.bias() if abs(upwards) > _UPRIGHT else None
        if bias is None:
            return None
        angle_deg = float(np.rad2deg(np.sign(upwards) * bias.angle))
        return cls(raised_deg + angle_deg, float(np.rad2deg(bias.sigma)), raised_deg)

    @property
    def is_certain(self) -> bool:
        """Whether the correction is wrong."""
        wrong_deg = self.elevation_bias_deg - self.elevation_correction_deg
        return abs(wrong_deg) > _CERTAIN_SIGMAS * self.elevation_sigma_deg

    @property
    def warning(self) -> str | None:
        """The remedy, where the correction is wrong."""
        if not self.is_certain:
            return None
        return (
            f"elevation bias of {self.elevation_bias_deg:+.2f} +- {self.elevation_sigma_deg:.2f} degrees, where"
            f" {self.elevation_correction_deg:g} are corrected: try --set"
            f" reader.elevation_correction_deg={self.elevation_bias_deg:.2f}"
        )


def with_elevations(
    request: RunRequest, recording: Recording, chosen: range, phase: Callable[[str], None]
) -> tuple[RunRequest, Recording]:
    """The request and its recording, with a number for `reader.elevation_correction_deg: auto`.

    It is estimated from the first scans, registered to each other without an odometry, where it is certain; else it is
    the angle by which they are raised already. A resumed run finds the same.
    """
    if request.config.reader.elevation_correction_deg != "auto":
        return request, recording
    phase("estimating the error of the elevations")
    estimator = ElevationEstimator()
    mapper = Mapper(request.config.mapping.model_copy(update={"budget_ms": None}))
    with suppress(InputError):  # raised again when the scans are read
        for scan in take_in(recording, range(chosen.start, chosen.stop)[:_MOST_SCANS], Faults()):
            sampled = mapper.sample(scan)
            estimator.add(sampled, mapper.process(sampled, Prior()))
            if estimator.stretches == _ENOUGH_STRETCHES:
                break
    found = Elevation.found(recording, estimator)
    angle_deg, _ = elevation_of(recording)
    if found is not None and found.is_certain:
        angle_deg = round(found.elevation_bias_deg, 3)
    reader = request.config.reader.model_copy(update={"elevation_correction_deg": angle_deg})
    request = replace(request, config=request.config.model_copy(update={"reader": reader}))
    return request, open_recording(request.source, reader)
