"""Where a method lost track: runs of lost scans."""

from dataclasses import dataclass

import numpy as np

from evaluation.comparison.comparison import MethodResult


@dataclass(frozen=True)
class LostStretch:
    """Successive lost scans.

    Attributes:
        first, last: rows of the method's trajectory, both inclusive.
        begin_s, end_s: their stamps.
        reason: why.
    """

    first: int
    last: int
    begin_s: float
    end_s: float
    reason: str

    @property
    def scans(self) -> int:
        """How many scans were lost."""
        return self.last - self.first + 1


def lost_stretches(method: MethodResult) -> list[LostStretch]:
    """The lost stretches in the order of time; none without a trajectory."""
    if method.lost is None or method.trajectory is None:
        return []
    edges = np.flatnonzero(np.diff(np.r_[False, method.lost, False]))
    stamps = method.trajectory.stamps
    bounds = list(zip(edges[::2], edges[1::2], strict=True))
    reasons = method.lost_reasons if len(method.lost_reasons) == len(bounds) else [method.message] * len(bounds)
    return [
        LostStretch(int(first), int(past) - 1, float(stamps[first]), float(stamps[past - 1]), reason)
        for (first, past), reason in zip(bounds, reasons, strict=True)
    ]
