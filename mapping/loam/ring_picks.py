"""Which places along the rings are picked: local maxima, and the best of every sector."""

import numpy as np
from numpy.typing import NDArray

from mapping.loam.ring_curves import RingCurves
from mapping.loam.ring_layout import HALF_WINDOW, Floats, Indices

# A pick keeps its neighbours from being picked, up to a step as long as this, squared metres.
_BREAK_M2 = 0.05
# Rounds of the search; two find all there is in scans of streets and offices.
_ROUNDS = 3


def local_maxima(curves: RingCurves, places: Indices, values: Floats) -> Indices:
    """Which (K,) of these ascending places are picked: those that none of more value within reach keeps from it.

    One by one, from the largest down, every pick would rule out its neighbours. Here all those that are the largest
    within reach are picked at once, then the same among what they do not rule out; repeated to the end this gives the
    same set.
    """
    # Places between two long steps share a number.
    pieces = np.cumsum(curves.gaps2 > _BREAK_M2, dtype=np.int32)[places - 1]
    picked = []
    left = np.arange(len(places))
    for _ in range(_ROUNDS):
        first, second = _within_reach(places[left], pieces[left])
        second_loses = values[left[second]] <= values[left[first]]
        beaten = np.zeros(len(left), dtype=bool)
        beaten[np.where(second_loses, second, first)] = True
        picked.append(left[~beaten])
        ruled_out = ~beaten
        ruled_out[second[~beaten[first]]] = True
        ruled_out[first[~beaten[second]]] = True
        left = left[~ruled_out]
    return np.concatenate(picked)


def _within_reach(places: Indices, pieces: NDArray[np.int32]) -> tuple[Indices, Indices]:
    """All pairs of places, as positions among them, that are close enough for one to rule out the other."""
    pairs = []
    for step in range(1, min(HALF_WINDOW + 1, len(places))):
        near = (places[step:] - places[:-step] <= HALF_WINDOW) & (pieces[step:] == pieces[:-step])
        first = np.flatnonzero(near)
        pairs.append((first, first + step))
    if not pairs:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    return np.concatenate([pair[0] for pair in pairs]), np.concatenate([pair[1] for pair in pairs])


def rank_in_sector(sectors: Indices, badness: Floats) -> Indices:
    """Place (K,) of each, from 0, among those of its sector, the least bad first."""
    order = np.lexsort((badness, sectors))
    ordered = sectors[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    rank = np.empty(len(order), dtype=np.intp)
    rank[order] = np.arange(len(order)) - np.repeat(first, np.diff(first, append=len(order)))
    return rank
