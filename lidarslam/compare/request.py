"""A comparison as it is asked for: recordings, methods, limits, tables."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from evaluation.comparison.mean_table import TablePlan
from lidarslam.compare.methods import Method
from lidarslam.compare.supervised import Limits


class Simulated(BaseModel):
    """A recording that is simulated when it is not there; names as in `lidarslam simulate`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    world: str = "office"
    sensor: str = "vlp-16"
    motion: str = "handheld"
    speed_mps: float | None = Field(None, gt=0.0, description="null: that of the motion and the world")
    mount: str = "upright"
    scans: int = Field(300, ge=1)
    seed: int = Field(0, ge=0)
    format: str = "mcap"


@dataclass(frozen=True)
class RecordingEntry:
    """One recording of a comparison, as in a benchmark file too.

    Attributes:
        source: where it lies; None only where it is simulated.
        name: in tables and of its folder; None: the recording's own.
        set: settings for this recording alone, `key.path=value`.
        start, stop, step: which scans, as in `range`.
        prior: TUM file for the methods that take their motions from one.
        reference: a method's name or a TUM file; None: the ground truth.
        reference_map: a point cloud; None: the map that a simulated recording came with.
        simulate: how it is made when it is not there.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    source: Path | None = None
    name: str | None = None
    set: tuple[str, ...] = ()
    start: Annotated[int, Field(ge=0)] = 0
    stop: Annotated[int, Field(ge=0)] | None = None
    step: Annotated[int, Field(ge=1)] = 1
    prior: Path | None = None
    reference: str | None = None
    reference_map: Path | None = None
    simulate: Simulated | None = None


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
        reuse: whether finished runs in `out` with the same settings are kept.
        skip_missing: whether recordings that are not there are left out and named, instead of an error.
        title, command: of the report; how to make it again.
        tables: means over recordings.
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
