"""A benchmark file: recordings, methods, tables and published rows, so that a table of a paper is one command."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Self

from pydantic import Field, ValidationError, model_validator

from lidarslam.compare.methods import Method, parse_method
from lidarslam.compare.plan import CompareRequest, RecordingEntry
from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.files import require_no_link
from lidarslam.core.settings import Settings
from lidarslam.core.tasks import open_tasks
from lidarslam.datasets.fetched import fetched, is_url
from lidarslam.datasets.published.evalio import located
from lidarslam.evaluation.comparison.quantities import TablePlan
from lidarslam.simulation.record import README, REFERENCE_MAP, RecordRequest, record
from lidarslam.storage.finished_run import RECORDINGS


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


def make_recordings(
    request: CompareRequest, counting: Callable[[str], AbstractContextManager[Callable[[int, int], None]]]
) -> None:
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
            with counting(f"recording {one.out.name}") as counter:
                record(one, counter)
        return
    with counting(f"{len(wanted)} recordings side by side") as counter, open_tasks(request.where) as tasks:
        scans = [one.scans for one in wanted]
        for number, _ in enumerate(tasks.run(_record, wanted), start=1):
            counter(sum(scans[:number]), sum(scans))


def _record(request: RecordRequest) -> None:
    record(request, lambda *_: None)


def _located(entry: RecordingEntry, benchmark: Benchmark, data: Path | None, out: Path) -> RecordingEntry:
    """The recording with paths as they are found from here."""
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
