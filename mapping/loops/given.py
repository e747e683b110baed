"""Loop closures that are given or forbidden by hand, as pairs of scans."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# So many scans on either side of a scan are near it; a way on would not be known before they have come.
NEAR_SCANS = 50


@dataclass(frozen=True)
class GivenLoops:
    """Pairs of scans, by their indices in the run, the earlier one first."""

    closed: tuple[tuple[int, int], ...] = ()  # which show the same place
    forbidden: tuple[tuple[int, int], ...] = ()  # near which nothing that is found is a closure

    def barred(self, scans: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(K,) which keyframes, of the scans (K,), are not to be closed with the last one."""
        barred = np.zeros(len(scans), dtype=np.bool_)
        for first, second in self.forbidden:
            if abs(scans[-1] - second) <= NEAR_SCANS:
                barred |= np.abs(scans - first) <= NEAR_SCANS
        return barred
