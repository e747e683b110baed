"""Wall times of scans in a few numbers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.pipeline.estimates import STAGES


@dataclass(frozen=True)
class Milliseconds:
    """Median, 95th and 99th percentile of wall times."""

    median: float
    p95: float
    p99: float

    @classmethod
    def of(cls, values: Sequence[float] | FloatArray) -> "Milliseconds":
        """Of at least one time."""
        return cls(*(float(np.percentile(values, share)) for share in (50.0, 95.0, 99.0)))


@dataclass(frozen=True)
class SlowestScan:
    """The longest stage of any scan but the first, which waits for loops to be loaded."""

    scan: int
    stage: str
    ms: float

    @classmethod
    def of(cls, stage_ms: FloatArray) -> "SlowestScan | None":
        """By the times (N, S) of the `STAGES`; None of fewer than two scans."""
        if len(stage_ms) < 2:
            return None
        scan, stage = divmod(int(stage_ms[1:].argmax()), stage_ms.shape[1])
        return cls(scan + 1, STAGES[stage], float(stage_ms[scan + 1, stage]))
