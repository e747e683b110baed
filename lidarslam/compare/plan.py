"""A comparison as it is asked for, and its runs; mistakes are found here, before the first method is run."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import ConfigDict, Field

from lidarslam.compare.method_run import PROCESS, MethodRun
from lidarslam.compare.methods import Method, scene_range_m
from lidarslam.compare.peers.interface import MAX_RANGE_M
from lidarslam.compare.supervised import Limits
from lidarslam.config.settings import load_config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.files import require_no_link
from lidarslam.core.settings import Settings
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.core.text import require_name, safe_name
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.comparison.comparison import MissingRecording
from lidarslam.evaluation.comparison.gates import Gate
from lidarslam.evaluation.comparison.quantities import TablePlan
from lidarslam.run.request import RunRequest
from lidarslam.storage import directory as files
from lidarslam.storage.finished_run import COMPARISON, RESERVED


class Simulated(Settings):
    """A recording that is simulated when it is not there; names as in `lidarslam simulate`."""

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

    source: Path | None = None  # its path; None only where it is simulated
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
    # file with recordings, methods and tables, and the root of its paths; see `lidarslam.compare.benchmark`
    benchmark: Path | None = None
    data: Path | None = None
    gates: tuple[Gate, ...] = ()  # bounds of the figures


@dataclass(frozen=True, eq=False)
class PlannedRecording:
    """One recording under a name of its own, and its runs, one per method, each into a directory with its name."""

    name: str
    source: Path
    entry: RecordingEntry
    recording: Recording
    range_m: float | None  # maximum range by the size of the scene; None where no method asks for it
    runs: tuple[MethodRun, ...]


def make_plan(request: CompareRequest) -> tuple[list[PlannedRecording], list[MissingRecording]]:
    """Open every recording and resolve every configuration; the planned recordings and the missing ones."""
    planned: list[PlannedRecording] = []
    missing: list[MissingRecording] = []
    for entry in request.recordings:
        source = entry.source or Path()
        try:
            planned.append(_plan_recording(request, entry, source, {other.name for other in planned}))
        except InputError as error:
            if not request.skip_missing:
                raise
            missing.append(MissingRecording(entry.name or source.name, str(source), str(error)))
    if not planned:
        raise InputError(f"none of the {len(missing)} recordings can be read; {missing[0].reason}")
    _check_folder(request, planned)
    return planned, missing


def _plan_recording(request: CompareRequest, entry: RecordingEntry, source: Path, taken: set[str]) -> PlannedRecording:
    settings = [*request.settings, *entry.set]
    recording = open_recording(source, load_config(request.config_file, settings).reader)
    if not len(recording):
        raise InputError(f"{source}: holds no scan")
    _check_entry(request, entry)
    name = entry.name or safe_name(recording.name)
    candidates = [name, *(f"{name}-{number}" for number in range(2, len(taken) + 3))]
    name = next(candidate for candidate in candidates if candidate not in taken | RESERVED)
    runs = []
    chosen = range(len(recording))[entry.start : entry.stop : entry.step]
    range_m = scene_range_m(recording, chosen) if any(method.by_scene for method in request.methods) else None
    for method in request.methods:
        config = load_config(request.config_file, [*settings, *method.settings_at(range_m or MAX_RANGE_M)])
        folder = request.out / name / method.name
        prior = entry.prior if method.needs_prior else None
        run = RunRequest(source, folder, config, entry.start, entry.stop, entry.step, prior)
        runs.append(MethodRun(run, method.peer, range_m if method.by_scene else None))
    return PlannedRecording(name, source, entry, recording, range_m, tuple(runs))


def _check_entry(request: CompareRequest, entry: RecordingEntry) -> None:
    names = [method.name for method in request.methods]
    wanting = [method.name for method in request.methods if method.needs_prior]
    if wanting and entry.prior is None:
        raise ConfigError(f"{wanting[0]}: takes its motions from a trajectory; give one with --prior FILE")
    if entry.reference is not None and entry.reference not in names and not Path(entry.reference).is_file():
        raise ConfigError(f"reference {entry.reference!r}: is neither a file nor one of the methods {', '.join(names)}")


def _check_folder(request: CompareRequest, planned: list[PlannedRecording]) -> None:
    out = request.out
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: a file is in the way; name another directory")
    if any(out.resolve() == recording.source.resolve() for recording in planned):
        raise OutputError(f"{out}: is the recording itself; name another directory for the comparison")
    if (out / files.TRAJECTORY_TUM).is_file() and (out / files.CONFIG).is_file():
        raise OutputError(f"{out}: holds a run; name another directory for the comparison")
    folders = [run.request.out for recording in planned for run in recording.runs]
    require_no_link([place for folder in folders for place in (folder.parent, folder)])
    if request.overwrite or request.reuse:
        return
    marks = [out / COMPARISON, *(folder / name for folder in folders for name in (PROCESS, files.CONFIG))]
    found = next((mark for mark in marks if mark.exists()), None)
    if found is not None:
        raise OutputError(
            f"{out}: holds a comparison already ({found.relative_to(out)}); name another directory, take what is"
            " finished of it with --reuse, or replace it with --overwrite"
        )
