"""Tracking state: the certainty of pose and motion, and therefore the extent of the search for the next scan."""

from dataclasses import dataclass, field, replace

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import MotionState, OdometryNoise, Prediction, Prior, ProcessNoise, predict
from lidarslam.mapping.registration.sampled_scan import SampledScan

# After a gap of this length between scans the pose is uncertain.
_GAP_S = 1.0
# A relocalisation is confirmed by this many consistent scans over at least this time.
_CONFIRMED_BY, _CONFIRMED_AFTER_S = 3, 1.0
_ROUNDING_S = 1e-3
# A search of the whole map takes a second or two: it is made at these lost scans in a row, and then periodically.
_SEARCHES_AT, _SEARCHES_EVERY = (1, 2, 4, 8, 13), 20
# A scan fits poorly below this share of the usual quality, which is smoothed over the latest scans.
_POOR_SHARE, _SMOOTHING = 0.9, 0.2
# Scans in a row at which odometry and registration conflict: 10 to 22 in crowds that walk along, at most 5 elsewhere.
_LASTING_CONFLICT = 6
# Lost scans in a row after which a new map is begun. Scans without points do not count.
GIVE_UP_AFTER = 20
# Registration begins on coarse cells unless the predictions were off by less than this share of a cell lately; their
# error is forgotten by a factor per scan.
_FINE_ERROR_CELLS, _ERROR_DECAY, _UNKNOWN_ERROR_M = 0.5, 0.8, 10.0


@dataclass(frozen=True)
class TrackingState:
    """Summary of the latest scans."""

    lost_in_a_row: int = 0  # scans with points that could not be registered
    is_lost: bool = False  # whether the pose of the last scan is unknown
    velocity_known: bool = False  # whether the velocity of the last scan was estimated
    tracked_s: float | None = None  # stamp of the last scan whose pose followed from the one before
    was_degraded: bool = False  # the second degraded scan in a row is searched for nearby
    to_confirm: int = 0  # scans that have to confirm a relocalisation
    relocalised_s: float | None = None  # stamp of a relocalisation until it is confirmed
    usual_quality: float = 0.0
    conflicts: int = 0  # scans in a row at which odometry and registration measured different motions
    lasting_conflict: str | None = None  # its axis, once there are enough of them
    is_measured: bool = False  # whether a proven odometry measured every motion since the sensor was tracked
    prediction_error_m: float = _UNKNOWN_ERROR_M
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)

    @property
    def is_unconfirmed(self) -> bool:
        """Whether the sensor was relocalised and the next scans have not confirmed it yet."""
        return self.relocalised_s is not None

    @property
    def searches_map(self) -> bool:
        """Whether the whole map is searched if the next scan fits nowhere nearby."""
        number = self.lost_in_a_row + 1
        return number in _SEARCHES_AT or number % _SEARCHES_EVERY == 0

    @property
    def gives_up(self) -> bool:
        """Whether enough scans were lost to begin a new map."""
        return self.lost_in_a_row >= GIVE_UP_AFTER

    def is_uncertain(self, interval_s: float) -> bool:
        """Whether the pose of a scan after an interval may be far from its prediction."""
        return self.is_lost or interval_s > _GAP_S

    def fits_poorly(self, status: Status, quality: float) -> bool:
        """Whether a scan fits worse than the latest scans did."""
        return status is not Status.OK or quality < _POOR_SHARE * self.usual_quality

    def begins_coarse(self, scan: SampledScan, prediction: Prediction) -> bool:
        """Whether the registration of a scan begins on coarse cells."""
        within_m = _FINE_ERROR_CELLS * scan.cell_m
        return self.prediction_error_m > within_m and not prediction.is_held_within(within_m)

    def predict(
        self, scan: SampledScan, prior: Prior, last: MotionState, config: MappingConfig,
        process_noise: ProcessNoise | None = None,
    ) -> Prediction:  # fmt: skip
        """Predict a scan's state from the last one and the odometry."""
        noise = process_noise or self.process_noise
        return predict(last, scan.stamp, prior, noise, config, scan.seen_from_s, self.odometry_noise)

    def lost(self, has_points: bool) -> "TrackingState":
        """After a scan that was not registered, for lack of points or of fit."""
        return replace(
            self,
            lost_in_a_row=self.lost_in_a_row + has_points,
            is_lost=True,
            velocity_known=False,
            relocalised_s=None,
            is_measured=self.is_measured and has_points,
            prediction_error_m=_UNKNOWN_ERROR_M,
        )

    def in_new_map(self) -> "TrackingState":
        """After a new map was begun."""
        return replace(self, lost_in_a_row=0, usual_quality=0.0, tracked_s=None)

    def registered(self, status: Status, relocalised: bool, quality: float, stamp: float) -> "TrackingState":
        """After a registered scan."""
        to_confirm, relocalised_s, usual = self.to_confirm, self.relocalised_s, self.usual_quality
        if status is Status.OK:
            usual += _SMOOTHING * (quality - usual)
        if relocalised:
            to_confirm, relocalised_s = _CONFIRMED_BY, stamp
        elif relocalised_s is not None and status is Status.OK:
            to_confirm -= 1
            if to_confirm <= 0 and stamp - relocalised_s >= _CONFIRMED_AFTER_S - _ROUNDING_S:
                relocalised_s = None
        return replace(
            self,
            lost_in_a_row=0,
            is_lost=False,
            tracked_s=stamp if relocalised_s is None else self.tracked_s,
            was_degraded=status is Status.DEGRADED,
            to_confirm=to_confirm,
            relocalised_s=relocalised_s,
            usual_quality=usual,
            is_measured=self.is_measured or relocalised_s is None,
        )

    def moved(
        self, last: MotionState, state: MotionState, motion: FloatArray, prior: Prior, config: MappingConfig
    ) -> "TrackingState":
        """With the noise of acceleration and odometry as a tracked motion (4, 4) shows it."""
        interval_s, process_noise = state.stamp - last.stamp, self.process_noise
        if interval_s > 0.0 and self.velocity_known:
            variance = np.diag(state.covariance + last.covariance)[6:]
            process_noise = process_noise.updated(state.velocity - last.velocity, interval_s, variance)
        odometry_noise = self.odometry_noise.updated(prior, motion, config)
        axis = odometry_noise.conflict(prior, motion, interval_s)
        conflicts = 0 if axis is None else self.conflicts + 1
        lasting = axis if conflicts >= _LASTING_CONFLICT else None
        noise = replace(self, process_noise=process_noise, odometry_noise=odometry_noise)
        return replace(noise, conflicts=conflicts, lasting_conflict=lasting)

    def with_prediction_error(self, error_m: float) -> "TrackingState":
        """With the error of the latest prediction."""
        return replace(self, prediction_error_m=max(_ERROR_DECAY * self.prediction_error_m, error_m))
