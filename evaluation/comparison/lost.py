"""Intervals in which a method lost tracking."""

from dataclasses import dataclass

import numpy as np

from lidarslam.evaluation.comparison.comparison import MethodResult

# Runs of lost scans with a shorter tracked gap between them are one interval.
_MERGED_GAP_S = 1.0


@dataclass(frozen=True)
class LostInterval:
    """Lost scans with no tracked gap of a second or more between them."""

    # first, last: rows of the method's trajectory, both inclusive
    first: int
    last: int
    # begin_s, end_s: their times since the method's first scan
    begin_s: float
    end_s: float
    scans: int  # number of lost scans among them
    reason: str  # of the first loss, and the number of others


def lost_intervals(method: MethodResult) -> list[LostInterval]:
    """The intervals in order of time; none without a trajectory."""
    if method.lost is None or method.trajectory is None:
        return []
    times_s = method.trajectory.stamps - method.trajectory.stamps[:1]
    edges = np.flatnonzero(np.diff(np.r_[False, method.lost, False]))
    runs = list(zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True))
    reasons = method.lost_reasons if len(method.lost_reasons) == len(runs) else [method.message] * len(runs)
    merged: list[tuple[int, int, list[str]]] = []
    for (first, last), reason in zip(runs, reasons, strict=True):
        if merged and times_s[first] - times_s[merged[-1][1]] < _MERGED_GAP_S:
            begin, _, earlier = merged.pop()
            merged.append((begin, last, [*earlier, reason]))
        else:
            merged.append((first, last, [reason]))
    return [
        LostInterval(
            first,
            last,
            float(times_s[first]),
            float(times_s[last]),
            int(method.lost[first : last + 1].sum()),
            why[0] if len(why) == 1 else f"{why[0]}, and {len(why) - 1} more",
        )
        for first, last, why in merged
    ]
