"""A comparison as it is asked for, also by a benchmark file, and its runs; mistakes are found before the first run.

The command line names methods BASE[@VOXEL][+map|+loam][+graph], or PEER[@scene].
"""

import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import ConfigDict, Field, ValidationError, model_validator

from lidarslam.compare.method_run import PROCESS, Limits, MethodRun
from lidarslam.compare.peers.estimation import ALL_PEERS, PEERS, peer_named
from lidarslam.compare.peers.interface import MAX_RANGE_M
from lidarslam.config.settings import load_config, read_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.files import require_no_link
from lidarslam.core.settings import Settings
from lidarslam.core.tasks import SERIAL, Where, open_tasks
from lidarslam.core.text import require_name, safe_name
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.fetched import fetched, is_url
from lidarslam.datasets.published.evalio import located
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.comparison.comparison import MissingRecording, TablePlan
from lidarslam.evaluation.comparison.gates import Gate
from lidarslam.mapping.config import MappingName
from lidarslam.odometry.config import ODOMETRIES
from lidarslam.run.progress import show_count
from lidarslam.run.request import RunRequest
from lidarslam.simulation.record import README, REFERENCE_MAP, RecordRequest, record
from lidarslam.storage import directory as files
from lidarslam.storage.finished_run import COMPARISON, RECORDINGS, RESERVED

# Name for the user -> name of the odometry in the configuration.
_BASES = {
    "learned": "learned",
    "kiss-icp": "kiss-icp",
    "kiss-icp-no-deskew": "kiss-icp",
    "constant-velocity": "constant-velocity",
    "imu": "imu",
    "learned+imu": "learned+imu",
    "prior": "external",
}
_NO_DESKEW = "kiss-icp-no-deskew"
# Behind a method's name, the maximum range by the size of the scene: KISS-ICP's voxels are a hundredth of its maximum
# range, 100 m by default, which suits streets; its authors advise a shorter range indoors. One rule for KISS-ICP and
# every peer with voxels: twice the range of 99 % of the points of the first scans, as the default is on streets.
BY_SCENE = "scene"
_SCANS, _PERCENT, _TIMES = 10, 99.0, 2.0
# As KISS-ICP's authors advise for indoor data; finer voxels than a tenth of the default would hold single points.
_SHORTEST_M = 10.0
DEFAULT_METHODS = "learned+map,kiss-icp"
# A peer's run: its poses as they are.
_PEER = ("odometry.method=external", "mapping.method=off", "pose_graph.enabled=false")
_ONLY_WITH_MAP = ("constant-velocity", "imu", "learned+imu")
_NAME = re.compile(
    r"(?P<base>[A-Za-z][\w.-]*(\+imu)?)(@(?P<voxel>[^+@]+))?(?P<mapping>\+map|\+loam)?(?P<graph>\+graph)?"
)
_MAPPINGS: dict[str | None, MappingName] = {"+map": "surfels", "+loam": "loam", None: "off"}


@dataclass(frozen=True)
class Method:
    """One method of a comparison."""

    name: str  # as the user named it, such as `kiss-icp@0.5` or `learned+map`, and of its run directory
    settings: tuple[str, ...]  # of the configuration, `key.path=value`
    peer: str | None = None  # the peer that estimates the poses, see `lidarslam.compare.peers`
    by_scene: bool = False  # whether maximum range and voxels follow the size of the scene

    def __post_init__(self) -> None:
        require_name(self.name, "method", RESERVED)

    @property
    def needs_prior(self) -> bool:
        """Whether it takes its motions from a given trajectory."""
        return self.peer is None and "odometry.method=external" in self.settings

    def settings_at(self, range_m: float) -> tuple[str, ...]:
        """Its settings where the size of the scene asks for this maximum range."""
        if not self.by_scene:
            return self.settings
        by_scene = (f"odometry.kiss_icp.max_range_m={range_m!r}", "odometry.kiss_icp.voxel_size_m=null")
        return (*self.settings, *by_scene)


def _grammar() -> str:
    return (
        f"{', '.join([*_BASES, *ODOMETRIES.added])}; each with +map or +loam, with +graph, or with both as in"
        " learned+map+graph; kiss-icp@0.5 for a voxel size of 0.5 m; and as they are "
        f"{', '.join(ALL_PEERS.names)}; kiss-icp@{BY_SCENE}, and likewise a peer with voxels, for a range by the size"
        " of the scene"
    )


def parse_method(name: str) -> Method:
    """The method of that name."""
    peer, by_scene = name.removesuffix(f"@{BY_SCENE}"), name.endswith(f"@{BY_SCENE}")
    match = _NAME.fullmatch(name)
    base = "" if match is None else match["base"]
    if peer in PEERS or (base not in _BASES and peer in ALL_PEERS.added):
        if not peer_named(peer).has_voxels and by_scene:
            raise ConfigError(f"{name}: {peer} has no voxel size that could follow the size of the scene")
        return Method(name, _PEER, peer, by_scene)
    odometry = _BASES.get(base) or (base if base in ODOMETRIES.added else None)
    if match is None or odometry is None:
        raise ConfigError(f"no method is called {name!r}; there are: {_grammar()}")
    if odometry in _ONLY_WITH_MAP and not match["mapping"]:
        raise ConfigError(f"{name}: estimates a motion with a map alone; compare {odometry}+map or {odometry}+loam")
    by_scene = match["voxel"] == BY_SCENE and odometry == "kiss-icp"
    voxel = () if match["voxel"] is None or by_scene else (f"odometry.kiss_icp.voxel_size_m={match['voxel']}",)
    if voxel and odometry != "kiss-icp":
        raise ConfigError(f"{name}: only kiss-icp takes a voxel size, as in kiss-icp@0.5")
    deskew = ("odometry.kiss_icp.deskew=false",) if base == _NO_DESKEW else ()
    pose_graph = str(match["graph"] is not None).lower()
    switches = (f"mapping.method={_MAPPINGS[match['mapping']]}", f"pose_graph.enabled={pose_graph}")
    return Method(name, (f"odometry.method={odometry}", *voxel, *deskew, *switches), by_scene=by_scene)


def parse_methods(names: str) -> tuple[Method, ...]:
    """The methods of a list with commas."""
    chosen = [name.strip() for name in names.split(",") if name.strip()]
    if not chosen:
        raise ConfigError(f"no method is named; there are: {_grammar()}")
    if len(set(chosen)) < len(chosen):
        raise ConfigError(f"a method is named twice in {names!r}; name each once")
    return tuple(parse_method(name) for name in chosen)


def scene_range_m(recording: Recording, chosen: range) -> float:
    """Twice the range of 99 % of the points of the first ten chosen scans, within 10 and 100 m; no truth is used."""
    ranges = [np.empty(0)]
    with suppress(InputError):  # raised again when the methods read the scans
        for scan in recording.scans(chosen.start, chosen[:_SCANS].stop, chosen.step, Faults()):
            ranges.append(np.linalg.norm(scan.points, axis=1))
    found = np.concatenate(ranges)
    if not len(found):
        return MAX_RANGE_M
    return round(float(np.clip(_TIMES * np.percentile(found, _PERCENT), _SHORTEST_M, MAX_RANGE_M)), 1)


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
    # file with recordings, methods and tables, and the root of its paths; see `lidarslam.compare.plan`
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


class BenchmarkMethod(Settings):
    """A method under a name of its own, with settings of its own."""

    name: str
    method: str = Field(description="as --methods names it")
    set: tuple[str, ...] = Field((), description="settings, key.path=value")


class Benchmark(Settings):
    """The whole file; paths are relative to the data's folder."""

    title: str
    data: str | None = Field(None, description="the user's data below --data, in words")
    recordings: tuple[RecordingEntry, ...] = Field(min_length=1)
    methods: tuple[str | BenchmarkMethod, ...] = Field(min_length=1)
    set: tuple[str, ...] = Field((), description="settings for everything, key.path=value")
    reference: str | None = Field(None, description="a method's name; null: ground truth")
    tables: tuple[TablePlan, ...] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        names = [recording.name for recording in self.recordings]
        if None in names or len({*names}) < len(names):
            raise ValueError("a recording has no name, or two have the same name")
        methods = [method if isinstance(method, str) else method.name for method in self.methods]
        if len({*methods}) < len(methods):
            raise ValueError("two methods have the same name")
        for recording in self.recordings:
            if (recording.source is None) == (recording.simulate is None):
                raise ValueError(f"recording {recording.name}: give either source or simulate")
        for table in self.tables:
            unknown = {name for group in table.groups.values() for name in group}.difference(names)
            if unknown:
                listed = ", ".join(sorted(unknown))
                raise ValueError(f"table {table.title!r} names recordings that are not listed: {listed}")
        return self


def load_benchmark(path: Path) -> Benchmark:
    """Read a benchmark file."""
    try:
        return Benchmark.model_validate(read_yaml(path))
    except ValidationError as error:
        faults = [
            ": ".join(filter(None, [".".join(map(str, fault["loc"])), fault["msg"].removeprefix("Value error, ")]))
            for fault in error.errors()
        ]
        raise ConfigError(f"{path}: {'; '.join(faults)}") from None


def fill_request(request: CompareRequest, benchmark: Benchmark) -> CompareRequest:
    """The comparison of a benchmark; methods that the request names already replace its own.

    The benchmark's paths are relative to `request.data`; without it, to the current folder, and those of the
    recordings that are simulated to one in `request.out`.
    """
    return replace(
        request,
        recordings=tuple(_located(entry, benchmark, request.data, request.out) for entry in benchmark.recordings),
        methods=request.methods or tuple(_method(method) for method in benchmark.methods),
        settings=(*benchmark.set, *request.settings),
        skip_missing=True,
        title=benchmark.title,
        tables=benchmark.tables,
    )


def require_data(request: CompareRequest, benchmark: Benchmark) -> None:
    """Refuse a benchmark none of whose recordings is there or can be simulated."""
    if any(entry.simulate or (entry.source and entry.source.exists()) for entry in request.recordings):
        return
    place = "the current folder" if request.data is None else str(request.data)
    needed = "name their folder with --data" if benchmark.data is None else f"--data is {benchmark.data}"
    raise InputError(f"{benchmark.title}: none of its recordings is in {place}; {needed}")


def make_recordings(request: CompareRequest) -> None:
    """Simulate the recordings that are not there yet."""
    wanted = [
        RecordRequest(entry.source, **entry.simulate.model_dump())
        for entry in request.recordings
        if entry.simulate is not None and entry.source is not None and not (entry.source / README).is_file()
    ]
    made = [one.out for one in wanted if one.out.parent == request.out / RECORDINGS]
    require_no_link([request.out / RECORDINGS, *made])
    if request.where.jobs == 1 or len(wanted) < 2:  # a cluster may have other disks
        for one in wanted:
            with show_count(f"recording {one.out.name}") as counter:
                record(one, counter)
        return
    with show_count(f"{len(wanted)} recordings side by side") as counter, open_tasks(request.where) as tasks:
        scans = [one.scans for one in wanted]
        for number, _ in enumerate(tasks.run(record, wanted), start=1):
            counter(sum(scans[:number]), sum(scans))


def _located(entry: RecordingEntry, benchmark: Benchmark, data: Path | None, out: Path) -> RecordingEntry:
    root = data or Path()
    simulated = (data or out / RECORDINGS) / (entry.name or "")
    reference_map = None if entry.reference_map is None else root / entry.reference_map
    reference = entry.reference or benchmark.reference
    if entry.reference is not None and (root / entry.reference).is_file():
        reference = str(root / entry.reference)
    return replace(
        entry,
        source=simulated if entry.source is None else _found(root, entry.source),
        prior=None if entry.prior is None else root / entry.prior,
        reference=reference,
        reference_map=reference_map or (simulated / REFERENCE_MAP if entry.source is None else None),
    )


def _found(root: Path, source: Path) -> Path:
    return fetched(source) if is_url(source) else root / located(source)


def _method(method: str | BenchmarkMethod) -> Method:
    try:
        if isinstance(method, str):
            return parse_method(method)
        named = parse_method(method.method)
        return replace(named, name=method.name, settings=(*named.settings, *method.set))
    except ConfigError as error:
        raise ConfigError(f"{error}; the benchmark's methods can be replaced with --methods") from None
