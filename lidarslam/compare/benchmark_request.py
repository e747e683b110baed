"""From a benchmark file to what is compared: paths are found, simulated recordings made."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from evaluation.comparison.mean_table import TablePlan
from evaluation.comparison.quantities import find_quantity
from evaluation.comparison.table import TableCell, TableRow
from lidarslam.compare.benchmark import Benchmark, BenchmarkMethod, BenchmarkRecording, BenchmarkTable, Published
from lidarslam.compare.methods import Method, parse_method
from lidarslam.compare.plan import RECORDINGS
from lidarslam.compare.request import CompareRequest, RecordingEntry
from lidarslam.core.errors import ConfigError
from lidarslam.simulation.recording.folder import README, REFERENCE_MAP
from lidarslam.simulation.recording.record import record
from lidarslam.simulation.recording.request import RecordRequest

Counter = Callable[[int, int], None]


def fill_request(request: CompareRequest, benchmark: Benchmark, data: Path | None) -> CompareRequest:
    """The comparison that a benchmark asks for; methods that the request names already are taken instead of its own.

    Args:
        request: where it goes, limits, settings.
        benchmark: the file's content.
        data: the folder that the benchmark's paths are relative to; None: the current one, and for the recordings
            that are made one in `request.out`.

    Raises:
        ConfigError: a method does not exist, or not in this version.
    """
    return replace(
        request,
        recordings=tuple(_entry(recording, benchmark, data, request.out) for recording in benchmark.recordings),
        methods=request.methods or tuple(_method(method) for method in benchmark.methods),
        settings=(*benchmark.set, *request.settings),
        skip_missing=True,
        title=benchmark.title,
        tables=tuple(_table(table) for table in benchmark.tables),
    )


def make_recordings(
    benchmark: Benchmark, request: CompareRequest, counting: Callable[[str], AbstractContextManager[Counter]]
) -> None:
    """Make the simulated recordings that are not there yet; one that is there is taken for the one that is meant.

    Raises:
        LidarSlamError: one cannot be made.
    """
    for recording, entry in zip(benchmark.recordings, request.recordings, strict=True):
        if recording.simulate is not None and not (entry.source / README).is_file():
            with counting(f"recording {recording.name}") as counter:
                record(RecordRequest(entry.source, **recording.simulate.model_dump()), counter)


def _entry(recording: BenchmarkRecording, benchmark: Benchmark, data: Path | None, out: Path) -> RecordingEntry:
    root = Path() if data is None else data
    if recording.source is not None:
        source, reference_map = root / recording.source, None
    else:
        source = (out / RECORDINGS if data is None else data) / recording.name
        reference_map = source / REFERENCE_MAP
    if recording.reference_map is not None:
        reference_map = root / recording.reference_map
    return RecordingEntry(
        source=source,
        name=recording.name,
        settings=recording.set,
        start=recording.start,
        stop=recording.stop,
        step=recording.step,
        prior=None if recording.prior is None else root / recording.prior,
        reference=_reference(recording.reference, root) or benchmark.reference,
        reference_map=reference_map,
    )


def _reference(name: str | None, root: Path) -> str | None:
    """A file below the data's folder, or a method's name."""
    if name is None:
        return None
    return str(root / name) if (root / name).is_file() else name


def _method(method: str | BenchmarkMethod) -> Method:
    try:
        if isinstance(method, str):
            return parse_method(method)
        return Method(method.name, (*parse_method(method.method).settings, *method.set))
    except ConfigError as error:
        raise ConfigError(f"{error}; the benchmark's methods can be replaced with --methods") from None


def _table(table: BenchmarkTable) -> TablePlan:
    quantities = [find_quantity(name) for name in table.quantities]
    sizes = [len(group) for group in table.groups.values() for _ in quantities]
    published = tuple(_row(row, sizes) for row in table.published)
    return TablePlan(table.title, table.groups, quantities, published, table.note)


def _row(row: Published, sizes: Sequence[int]) -> TableRow:
    cells = [TableCell(value, size) for value, size in zip(row.values, sizes, strict=True)]
    return TableRow(row.method, cells, row.source)
