"""How far it is known where the sensor is: what makes tracking look around, and what makes it sure again."""

from lidarslam.core.state import Saved, State
from lidarslam.core.tracking import Status

# After so long without a scan the sensor may be anywhere.
_GAP_S = 1.0
# A place found again is confirmed by so many scans that lie where it leads one to expect them, and for so long; a scan
# that does not, contradicts it.
_CONFIRMED_BY = 3
_CONFIRMED_AFTER_S = 1.0
_ROUNDING_S = 1e-3
# Looking all over the map takes a second or two: it is done at these lost scans in a row, and at every so manieth.
_LOOKS_AT = (1, 2, 4, 8, 13)
_LOOKS_EVERY = 20
# Scans that lie on the map by less than this share of what was usual lately lie badly; what is usual follows the
# latest ones by this part.
_AS_USUAL = 0.9
_FOLLOWING = 0.2


class Doubt:
    """What the latest scans say about that.

    Attributes:
        lost_in_a_row: scans that had something to see, and fitted nowhere.
        is_astray: whether it is not known where the last scan was.
    """

    def __init__(self) -> None:
        self.lost_in_a_row = 0
        self.is_astray = False
        self._was_degraded = False
        self._to_confirm = 0
        self._found_s: float | None = None  # when it was found again, until that is confirmed
        self._usual = 0.0

    def state(self) -> State:
        """All of it."""
        return {
            "lost_in_a_row": self.lost_in_a_row,
            "is_astray": self.is_astray,
            "was_degraded": self._was_degraded,
            "to_confirm": self._to_confirm,
            "found_s": self._found_s,
            "usual": self._usual,
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self.lost_in_a_row = saved.integer("lost_in_a_row")
        self.is_astray = saved.flag("is_astray")
        self._was_degraded = saved.flag("was_degraded")
        self._to_confirm = saved.integer("to_confirm")
        self._found_s = saved.optional_number("found_s")
        self._usual = saved.number("usual")

    def is_surprised(self, interval_s: float) -> bool:
        """Whether a scan, so long after the last one, need not be near where it is expected."""
        return self.is_astray or interval_s > _GAP_S

    def lies_badly(self, status: Status, quality: float) -> bool:
        """Whether a scan lies on the map worse than scans did lately, though it may be good enough to be believed."""
        return status is not Status.OK or quality < _AS_USUAL * self._usual

    @property
    def looks_around(self) -> bool:
        """Whether a scan that lies badly is reason to look around: the second one in a row is."""
        return self._was_degraded

    @property
    def looks_everywhere(self) -> bool:
        """Whether it is time to look all over the map, should the next scan fit nowhere nearby."""
        number = self.lost_in_a_row + 1
        return number in _LOOKS_AT or number % _LOOKS_EVERY == 0

    @property
    def is_unconfirmed(self) -> bool:
        """Whether the sensor was found again, and the scans of the next second have not all confirmed it yet."""
        return self._found_s is not None

    def saw_nothing(self) -> None:
        """A scan had next to nothing to see."""
        self.is_astray, self._found_s = True, None

    def missed(self) -> None:
        """A scan fitted nowhere."""
        self.saw_nothing()
        self.lost_in_a_row += 1

    def began_anew(self) -> None:
        """Scans are held against another map from now on."""
        self.lost_in_a_row, self._usual = 0, 0.0

    def laid(self, status: Status, found: bool, quality: float, stamp: float) -> None:
        """A scan lies on the map so well, where it was expected or where it was found."""
        self.lost_in_a_row, self.is_astray = 0, False
        self._was_degraded = status is Status.DEGRADED
        if status is Status.OK:
            self._usual += _FOLLOWING * (quality - self._usual)
        if found:
            self._to_confirm, self._found_s = _CONFIRMED_BY, stamp
        elif self._found_s is not None and status is Status.OK:
            self._to_confirm -= 1
            if self._to_confirm <= 0 and stamp - self._found_s >= _CONFIRMED_AFTER_S - _ROUNDING_S:
                self._found_s = None
