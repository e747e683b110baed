"""A comparison as it is asked for: recordings, methods, limits, tables."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from lidarslam.compare.methods.names import Method
from lidarslam.compare.supervised import Limits
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.core.text import require_name
from lidarslam.evaluation.comparison.mean_table import TablePlan
from lidarslam.storage.comparison_folder import RESERVED


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
    """One recording of a comparison, as in a benchmark file too."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    source: Path | None = None  # where it lies; None only where it is simulated
    name: str | None = None  # in tables and of its folder; None: the recording's own
    set: tuple[str, ...] = ()  # settings for this recording alone, `key.path=value`
    # start, stop, step: which scans, as in `range`
    start: Annotated[int, Field(ge=0)] = 0
    stop: Annotated[int, Field(ge=0)] | None = None
    step: Annotated[int, Field(ge=1)] = 1
    prior: Path | None = None  # TUM file for the methods that take their motions from one
    reference: str | None = None  # a method's name or a TUM file; None: the ground truth
    reference_map: Path | None = None  # a point cloud; None: the map that a simulated recording came with
    simulate: Simulated | None = None  # how it is made when it is not there

    def __post_init__(self) -> None:
        if self.name is not None:
            require_name(self.name, "recording", RESERVED)


@dataclass(frozen=True)
class CompareRequest:
    """A comparison."""

    out: Path  # the folder for everything
    recordings: tuple[RecordingEntry, ...]  # one or more
    methods: tuple[Method, ...]  # in the order of the tables
    # config_file, settings: for every method on every recording; the method's own settings come last
    config_file: Path | None = None
    settings: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)  # of each method on each recording
    where: Where = SERIAL  # whether methods run one after another or side by side
    overwrite: bool = False  # whether an earlier comparison in `out` is replaced
    reuse: bool = False  # whether finished runs in `out` with the same settings are kept
    skip_missing: bool = False  # whether recordings that are not there are left out and named, instead of an error
    # title, command: of the report; how to make it again
    title: str = ""
    command: str = ""
    tables: tuple[TablePlan, ...] = ()  # means over recordings
