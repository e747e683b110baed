"""summary.json of a merge."""

from dataclasses import dataclass
from typing import Any

from lidarslam.run.summary.summary import GraphSummary, graph_and_map_json
from lidarslam.run.summary.written_map import WrittenMap


@dataclass(frozen=True)
class MergedRecording:
    """One recording of a merge."""

    name: str  # of the recording
    directory: str | None  # of its run, beside the common map; None when no scan could be used
    source: str  # its path
    # scans, length_m, lost_scans: of its run
    scans: int
    length_m: float
    lost_scans: int
    joined: bool  # whether its poses are in the common frame


@dataclass(frozen=True)
class MergeSummary:
    """The content of summary.json of a merge."""

    recordings: tuple[MergedRecording, ...]
    elapsed_s: float
    peak_rss_mb: float
    graph: GraphSummary | None
    map: WrittenMap
    warnings: tuple[str, ...]

    @property
    def lost_scans(self) -> int:
        """Number of lost scans of all recordings."""
        return sum(recording.lost_scans for recording in self.recordings)

    def to_json(self) -> dict[str, Any]:
        """The content of summary.json."""
        return {
            "recordings": [vars(recording) for recording in self.recordings],
            "elapsed_s": self.elapsed_s,
            "peak_rss_mb": self.peak_rss_mb,
            "lost_scans": self.lost_scans,
            **graph_and_map_json(self.graph, self.map, self.warnings),
        }
