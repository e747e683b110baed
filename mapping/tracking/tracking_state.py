"""Tracking state: the certainty of the sensor's pose, and therefore the extent of the search for the next scan."""

from lidarslam.core.state import Stateful
from lidarslam.core.tracking import Status

# After a gap of this length between scans the pose is uncertain.
_GAP_S = 1.0
# A relocalisation is confirmed by this many consistent scans over at least this time.
_CONFIRMED_BY, _CONFIRMED_AFTER_S = 3, 1.0
_ROUNDING_S = 1e-3
# A search of the whole map takes a second or two: it is made at these lost scans in a row, and then periodically.
_SEARCHES_AT, _SEARCHES_EVERY = (1, 2, 4, 8, 13), 20
# A scan fits poorly below this share of the usual quality, which is smoothed over the latest scans.
_POOR_SHARE, _SMOOTHING = 0.9, 0.2
# Lost scans in a row after which a new map is begun. Scans without points do not count.
GIVE_UP_AFTER = 20


class TrackingState(Stateful):
    """Summary of the latest scans."""

    lost_in_a_row: int  # scans with points that could not be registered
    is_lost: bool  # whether the pose of the last scan is unknown
    velocity_known: bool  # whether the velocity of the last scan was estimated
    tracked_s: float | None  # stamp of the last scan whose pose followed from the one before
    _was_degraded: bool
    _to_confirm: int
    _relocalised_s: float | None
    _usual_quality: float

    def __init__(self) -> None:
        self.lost_in_a_row = 0
        self.is_lost = self.velocity_known = False
        self.tracked_s = None
        self._was_degraded = False
        self._to_confirm = 0
        self._relocalised_s = None  # stamp of a relocalisation until it is confirmed
        self._usual_quality = 0.0

    def is_uncertain(self, interval_s: float) -> bool:
        """Whether the pose of a scan after an interval may be far from its prediction."""
        return self.is_lost or interval_s > _GAP_S

    def fits_poorly(self, status: Status, quality: float) -> bool:
        """Whether a scan fits worse than the latest scans did."""
        return status is not Status.OK or quality < _POOR_SHARE * self._usual_quality

    @property
    def searches_nearby(self) -> bool:
        """Whether a degraded scan is searched for nearby: the second one in a row."""
        return self._was_degraded

    @property
    def searches_map(self) -> bool:
        """Whether the whole map is searched if the next scan fits nowhere nearby."""
        number = self.lost_in_a_row + 1
        return number in _SEARCHES_AT or number % _SEARCHES_EVERY == 0

    @property
    def gives_up(self) -> bool:
        """Whether enough scans were lost to begin a new map."""
        return self.lost_in_a_row >= GIVE_UP_AFTER

    @property
    def is_unconfirmed(self) -> bool:
        """Whether the sensor was relocalised and the next scans have not confirmed it yet."""
        return self._relocalised_s is not None

    def lost(self, has_points: bool) -> None:
        """Update with a scan that was not registered, for lack of points or of fit."""
        self.is_lost, self._relocalised_s, self.velocity_known = True, None, False
        self.lost_in_a_row += has_points

    def map_restarted(self) -> None:
        """Update with a new map."""
        self.lost_in_a_row, self._usual_quality, self.tracked_s = 0, 0.0, None

    def registered(self, status: Status, relocalised: bool, quality: float, stamp: float) -> None:
        """Update with a registered scan."""
        self.lost_in_a_row, self.is_lost = 0, False
        self._was_degraded = status is Status.DEGRADED
        if status is Status.OK:
            self._usual_quality += _SMOOTHING * (quality - self._usual_quality)
        if relocalised:
            self._to_confirm, self._relocalised_s = _CONFIRMED_BY, stamp
        elif self._relocalised_s is not None and status is Status.OK:
            self._to_confirm -= 1
            if self._to_confirm <= 0 and stamp - self._relocalised_s >= _CONFIRMED_AFTER_S - _ROUNDING_S:
                self._relocalised_s = None
        if not self.is_unconfirmed:
            self.tracked_s = stamp
