"""What is to be compared, on what, and how the result is to be shown."""

from dataclasses import dataclass, field
from pathlib import Path

from evaluation.comparison.comparison import PublishedRow
from evaluation.comparison.mean_table import TablePlan
from lidarslam.compare.methods import Method
from lidarslam.compare.supervised import Limits


@dataclass(frozen=True)
class RecordingEntry:
    """One recording of a comparison.

    Attributes:
        source: where it lies.
        name: in tables and of its folder; None: the recording's own.
        settings: `key.path=value`, for this recording alone.
        start, stop, step: which scans, as in `range`.
        prior: TUM file for the methods that take their motions from one.
        reference: a method's name or a TUM file that the trajectories are held against; None: the ground truth.
        reference_map: a point cloud that the maps are held against; None: the one a simulated recording came with.
    """

    source: Path
    name: str | None = None
    settings: tuple[str, ...] = ()
    start: int = 0
    stop: int | None = None
    step: int = 1
    prior: Path | None = None
    reference: str | None = None
    reference_map: Path | None = None


@dataclass(frozen=True)
class CompareRequest:
    """A comparison.

    Attributes:
        out: the folder for everything.
        recordings: one or more.
        methods: in the order of the tables.
        config_file, settings: for every method on every recording; the method's own settings come last.
        limits: of each method on each recording.
        overwrite: whether an earlier comparison in `out` is replaced.
        reuse: whether runs in `out` that were finished with the same settings are taken as they are.
        skip_missing: whether recordings that are not there are left out and named, instead of ending it all.
        title, command: of the report; how to make it again.
        tables: means over recordings that are wanted.
        published: others' rows that fit none of the tables.
    """

    out: Path
    recordings: tuple[RecordingEntry, ...]
    methods: tuple[Method, ...]
    config_file: Path | None = None
    settings: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    overwrite: bool = False
    reuse: bool = False
    skip_missing: bool = False
    title: str = ""
    command: str = ""
    tables: tuple[TablePlan, ...] = ()
    published: tuple[PublishedRow, ...] = ()
