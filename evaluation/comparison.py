"""What a comparison of methods holds: plain values that the report draws and comparison.json keeps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evaluation.trajectory_metrics import TrajectoryMetrics
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory

MethodStatus = Literal["ok", "lost", "stopped", "failed", "out of memory", "timed out"]
"""`lost`: finished, but tracking was lost on some scans. `stopped`: ended early with what there was. The last three:
nothing to show but the message."""


@dataclass(frozen=True, eq=False)
class MapErrors:
    """How far a method's map lies from the reference map, point by point, thinned for drawing.

    Attributes:
        points: (K, 3) points of the method's map, in the reference map's frame.
        distances_m: (K,) to the nearest point of the reference map.
    """

    points: FloatArray
    distances_m: FloatArray


@dataclass(frozen=True, eq=False)
class MethodResult:
    """One method on one recording; what could not be had is None.

    Attributes:
        name: as the user named it, such as `kiss-icp@0.5` or `learned+map`.
        status, message: how it ended, and why when it did not end well.
        trajectory: its poses, in its own world.
        lost: (N,) which of them were lost.
        metrics: its errors, with the association and the alignment they are of.
        map_metrics: the content of metrics.json's "map".
        map_errors: for the picture.
        ms_per_scan_median, ms_per_scan_p95: wall time from one finished scan to the next.
        stage_ms: median wall time of each stage; stages run beside one another.
        peak_rss_mb: of its process and its children.
        wall_s: of the whole process, from start to end.
        settings: the method's resolved configuration as YAML.
    """

    name: str
    status: MethodStatus
    message: str = ""
    scans: int = 0
    trajectory: Trajectory | None = None
    lost: NDArray[np.bool_] | None = None
    metrics: TrajectoryMetrics | None = None
    map_metrics: Mapping[str, object] | None = None
    map_errors: MapErrors | None = None
    ms_per_scan_median: float | None = None
    ms_per_scan_p95: float | None = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    peak_rss_mb: float | None = None
    wall_s: float | None = None
    settings: str = ""


@dataclass(frozen=True, eq=False)
class SequenceComparison:
    """All methods on one recording.

    Attributes:
        sequence: the recording's name.
        source: where it lies, as the user named it.
        reference: what the trajectories are held against; None when there is nothing.
        reference_name: "ground truth", or the method or file that serves as the reference.
        methods: in the order asked for.
    """

    sequence: str
    source: str
    reference: Trajectory | None
    reference_name: str
    methods: Sequence[MethodResult]


@dataclass(frozen=True)
class PublishedRow:
    """A row of somebody's published table, quoted beside ours.

    Attributes:
        method: as published.
        values: column -> value, for instance {"09 translation_percent": 6.05}.
        source: where it was published.
    """

    method: str
    values: Mapping[str, float | str]
    source: str


@dataclass(frozen=True, eq=False)
class Comparison:
    """Everything a report is made of.

    Attributes:
        title: of the report.
        command: that makes it again.
        sequences: one or more recordings.
        versions: name -> version of the programs that matter; "commit" when it is known.
        machine: name -> text, such as processor, cores, memory, system.
        published: rows quoted beside ours.
    """

    title: str
    command: str
    sequences: Sequence[SequenceComparison]
    versions: Mapping[str, str] = field(default_factory=dict)
    machine: Mapping[str, str] = field(default_factory=dict)
    published: Sequence[PublishedRow] = ()
