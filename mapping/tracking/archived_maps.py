"""Maps that tracking was lost in: when a scan of a map begun anew fits one of them, the sensor is back in it."""

from dataclasses import dataclass

from lidarslam.core.state import Saved
from lidarslam.core.state import State as Tree
from mapping.config import MappingConfig
from mapping.prediction import Prediction, State
from mapping.sampling import SampledScan
from mapping.surfels.surfel_map import LocalMap
from mapping.tracking.attempts import Placed, search_everywhere

# A map of fewer scans than this is not worth going back to.
_LEAST_SCANS = 5
# Looking takes a second: scans until the first look, how much longer each next wait is, and the longest.
_FIRST_WAIT = 5
_WAITS_GROW = 1.5
_LONGEST_WAIT = 60


@dataclass(frozen=True, eq=False)
class Return:
    """A scan that lies on an earlier map."""

    local_map: LocalMap
    placed: Placed


class EarlierMaps:
    """Keeps the maps that were given up, and now and then looks for a scan in them."""

    def __init__(self) -> None:
        self._maps: list[LocalMap] = []
        self._scans_until_look = 0
        self._wait = float(_FIRST_WAIT)

    def __len__(self) -> int:
        return len(self._maps)

    def state(self) -> Tree:
        """The maps, and when they are looked at."""
        maps = [local_map.state() for local_map in self._maps]
        return {"maps": maps, "scans_until_look": self._scans_until_look, "wait": self._wait}

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self._maps = [LocalMap.restored(part) for part in saved.parts("maps")]
        self._scans_until_look = saved.integer("scans_until_look")
        self._wait = saved.number("wait")

    def set_aside(self, local_map: LocalMap, scans: int) -> None:
        """Keep a map of so many scans that is given up; of several, the first and the last, to bound the memory."""
        if scans < _LEAST_SCANS:
            return
        self._maps = [*self._maps[:1], local_map]
        self._wait = float(_FIRST_WAIT)
        self._scans_until_look = _FIRST_WAIT

    def look(self, sampled: SampledScan, prediction: Prediction, last: State, config: MappingConfig) -> Return | None:
        """Where a scan lies on one of them, the latest first; None when it is not its turn, or lies on none.

        The map is in use again then, and no longer among these.
        """
        self._scans_until_look -= 1
        if not self._maps or self._scans_until_look > 0:
            return None
        self._wait = min(self._wait * _WAITS_GROW, _LONGEST_WAIT)
        self._scans_until_look = round(self._wait)
        for local_map in reversed(self._maps):
            placed = search_everywhere(sampled, prediction, last, local_map, config)
            if placed is not None:  # the ones after it were begun anew: nobody knows where they lie
                self._maps = self._maps[: self._maps.index(local_map)]
                return Return(local_map, placed)
        return None
