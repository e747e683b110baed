"""A comparison: every method on every recording, each in its own process; one result for all, and its text."""

import contextlib
import os
import platform
import subprocess
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from lidarslam.assessment.evaluate import EvaluateRequest, evaluate_map
from lidarslam.assessment.inputs import find_reference_map, load_reference_map, read_estimate
from lidarslam.compare import method_run
from lidarslam.compare.method_run import Limits, MethodRun
from lidarslam.compare.peers.interface import MAX_RANGE_M
from lidarslam.compare.plan import (
    BY_SCENE,
    CompareRequest,
    PlannedRecording,
    fill_request,
    load_benchmark,
    make_plan,
    make_recordings,
    require_data,
)
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import cannot_write, only_writer
from lidarslam.core.tasks import open_tasks, usable_cores
from lidarslam.core.text import as_typed, command_line, count, joined
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.fetched import fetch, url_of
from lidarslam.evaluation.comparison.comparison import (
    GROUND_TRUTH,
    QUANTITIES,
    WHOLE,
    Comparison,
    MethodResult,
    SequenceComparison,
    Table,
    TableCell,
    TableColumn,
    TableRow,
    mean_table,
    number_text,
    times_note,
)
from lidarslam.evaluation.comparison.gates import format_gates, judge_comparison, require_methods
from lidarslam.evaluation.trajectory.metrics import SHORT_LENGTHS_M, evaluate_trajectory
from lidarslam.run.interruption import ended_like_interrupted
from lidarslam.run.progress import show_count
from lidarslam.storage.directory import RunDirectory
from lidarslam.storage.finished_run import COMPARISON, REPORT_HTML, REPORT_MD, read_summary

_INTERRUPTED = "the comparison was interrupted before its turn"


@dataclass(frozen=True)
class CompareOutcome:
    """A comparison, and how it ended."""

    comparison: Comparison
    interrupted: bool  # whether Ctrl-C ended it early
    gates_passed: bool = True  # whether every bound of the request was met

    @property
    def is_empty(self) -> bool:
        """Whether no method has a result."""
        results = [result for sequence in self.comparison.sequences for result in sequence.methods]
        return all(result.trajectory is None for result in results)


def run_compare(request: CompareRequest, say: Callable[[str], None], tell: Callable[[str], None]) -> CompareOutcome:
    """Compare, and print the tables and the gates: `say` prints the result, `tell` the progress."""
    with ended_like_interrupted():  # or the methods would outlive a request to end
        if request.benchmark is not None:
            benchmark = load_benchmark(request.benchmark)
            request = fill_request(request, benchmark)
            require_data(request, benchmark)
        require_methods(request.gates, [method.name for method in request.methods])
        make_recordings(request)
        outcome = compare(request, tell)
    say(format_comparison(outcome.comparison, request.out))
    if outcome.is_empty:
        tell("no method came to a result; the table says why")
    if not request.gates:
        return outcome
    sequences = outcome.comparison.sequences
    runs = [result.run for sequence in sequences for result in sequence.methods if result.run]
    judged = judge_comparison(request.gates, sequences, {run: read_summary(request.out / run) for run in runs})
    say(f"\n{format_gates(judged)}")
    return replace(outcome, gates_passed=all(gate.passed for gate in judged))


def compare(
    request: CompareRequest, tell: Callable[[str], None], command: Sequence[str] = method_run.COMMAND
) -> CompareOutcome:
    """Run, evaluate, and write comparison.json and the report.

    A method that fails is a row; Ctrl-C ends the running method, and the results so far are written. `tell` is called
    with a line for each finished method; the command is the process of each, see `run_method`.
    """
    from lidarslam.evaluation.report.report import render_html, render_markdown

    recordings, missing = make_plan(request)
    try:
        request.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(request.out, error) from error
    turns, directory = _Turns(request, tell, command), RunDirectory(request.out)
    sequences: list[SequenceComparison] = []
    with only_writer(request.out):
        if not request.where.is_serial:
            turns.take_together(recordings)
        for planned in recordings:
            sequences.append(turns.measured(planned))
            if len(recordings) > 1:
                (request.out / planned.name).mkdir(exist_ok=True)  # not made where no method had its turn
                RunDirectory(request.out / planned.name).write_json(COMPARISON, sequences[-1].to_json())
        names = [sequence.sequence for sequence in sequences]
        comparison = Comparison(
            title=request.title or f"Comparison on {names[0] if len(names) == 1 else f'{len(names)} recordings'}",
            command=request.command,
            sequences=sequences,
            versions=versions(),
            machine=machine(),
            tables=[mean_table(table, sequences) for table in request.tables],
            missing=missing,
            notes=["interrupted: some methods ended early or were not run"] if turns.interrupted else [],
        )
        directory.write_json(COMPARISON, comparison.to_json())
        directory.write_text(REPORT_HTML, render_html(comparison))
        directory.write_text(REPORT_MD, render_markdown(comparison))
    return CompareOutcome(comparison, turns.interrupted)


@dataclass
class _Turns:
    request: CompareRequest
    tell: Callable[[str], None]
    command: Sequence[str]
    interrupted: bool = False
    # of those that ran side by side, by their directories
    _done: dict[Path, MethodResult] = field(default_factory=dict)

    def take_together(self, recordings: Sequence[PlannedRecording]) -> None:
        """Run all methods on all recordings side by side."""
        wanted = [(each, run) for each in recordings for run in each.runs if self._without_process(each, run) is None]
        if not wanted:
            return
        scans = [len(range(len(p.recording))[p.entry.start : p.entry.stop : p.entry.step]) for p, _ in wanted]
        counted = 0
        for _, run in wanted:
            (run.request.out / method_run.PROCESS).unlink(missing_ok=True)  # of an earlier comparison

        def take(index: int, result: MethodResult) -> None:
            nonlocal counted
            planned, run = wanted[index]
            if not (run.request.out / method_run.PROCESS).is_file():
                raise OutputError(
                    f"{self.request.out}: is not shared by the nodes of the cluster; name a folder that is with --out"
                )
            counted += scans[index]
            counter(counted, sum(scans))
            self._done[run.request.out] = result
            self.tell(format_result(planned.name, result))

        command = None if self.command == method_run.COMMAND else self.command
        run_one = partial(run_task, limits=self.request.limits, command=command, folder=str(Path.cwd()))
        tasks = [(run, url_of(run.request.source)) for _, run in wanted]
        with show_count(f"{count(len(tasks), 'run')} side by side") as counter:
            try:
                with open_tasks(self.request.where) as executor:
                    deque(executor.run(run_one, tasks, take), maxlen=0)
            except KeyboardInterrupt:
                self.interrupted = True

    def _without_process(self, planned: PlannedRecording, run: MethodRun) -> MethodResult | None:
        """An earlier result, or why there is none; None where the method has to be run."""
        if self.interrupted:
            return MethodResult(run.name, "not run", _INTERRUPTED)
        if self.request.reuse and (earlier := method_run.finished_before(run)) is not None:
            return earlier
        why = method_run.obstacle(run, planned.recording)
        return None if why is None else MethodResult(run.name, "not run", why)

    def measured(self, planned: PlannedRecording) -> SequenceComparison:
        """All methods on one recording, with their errors."""
        results = [self._done.get(run.request.out) or self._take(planned, run) for run in planned.runs]
        try:
            return measure(planned, results, with_maps=not self.interrupted)
        except KeyboardInterrupt:  # comparing maps takes time
            self.interrupted = True
            return measure(planned, results, with_maps=False)

    def _take(self, planned: PlannedRecording, run: MethodRun) -> MethodResult:
        known = self._without_process(planned, run)
        result = known or MethodResult(run.name, "not run", _INTERRUPTED)
        try:
            if known is None:
                with show_count(f"{planned.name} {run.name}") as counter:
                    result, self.interrupted = method_run.run_method(run, self.request.limits, counter, self.command)
        except KeyboardInterrupt:  # between two looks at the process
            self.interrupted = True
        self.tell(format_result(planned.name, result, known is not None and known.status in WHOLE))
        return result


def run_task(
    task: tuple[MethodRun, str | None], limits: Limits, command: Sequence[str] | None, folder: str
) -> MethodResult:
    """Run a method in a folder that relative paths are relative to, on whichever machine.

    With the method comes the URL of its source, where that was fetched. Without a command it is that of the machine.
    """
    run, url = task
    with contextlib.chdir(folder if Path(folder).is_dir() else "."):  # a machine without it has no file there either
        if url is not None:
            fetch(url, run.request.source)
        return method_run.run_method(run, limits, lambda *_: None, command or method_run.COMMAND)[0]


def measure(planned: PlannedRecording, results: Sequence[MethodResult], with_maps: bool = True) -> SequenceComparison:
    """The results on one recording, one per method, with the errors of trajectories and, if asked for, of maps."""
    notes = []
    if planned.range_m is not None:
        by_scene = f"maximum range {planned.range_m:g} m instead of {MAX_RANGE_M:g} m"
        notes.append(f"@{BY_SCENE}: {by_scene}, and voxels in proportion, by the ranges of the first scans")
    reference = _find_reference(planned, results, notes)
    measured = [_measure_trajectory(result, reference) for result in results]
    if with_maps:
        measured = _measure_maps(planned, measured, notes)
    return SequenceComparison(
        sequence=planned.name,
        source=str(planned.source),
        reference=reference,
        reference_name=planned.entry.reference or GROUND_TRUTH,
        methods=measured,
        notes=notes,
    )


def _find_reference(planned: PlannedRecording, results: Sequence[MethodResult], notes: list[str]) -> Trajectory | None:
    """The trajectory of a method or a file, or the ground truth; why there is none is added to the notes."""
    wanted = planned.entry.reference
    method = next((result for result in results if result.name == wanted), None)
    if method is not None and method.trajectory is not None:
        notes.append(f"errors are differences from {method.name}, which is no truth and has none itself")
        return method.trajectory
    if method is not None:
        notes.append(f"no errors are given: {method.name}, the reference, {method.status}")
        return None
    try:
        reference = planned.recording.ground_truth if wanted is None else read_tum(Path(wanted))
    except InputError as error:
        notes.append(f"no errors are given: {error}")
        return None
    if reference is None:
        why = "the recording came without ground truth; name a method or a file with --reference"
        notes.append(f"no errors are given: {why}")
    return reference


def _measure_trajectory(result: MethodResult, reference: Trajectory | None) -> MethodResult:
    if result.trajectory is None or reference is None or result.trajectory is reference:
        return result
    try:
        return replace(result, metrics=evaluate_trajectory(result.trajectory, reference))
    except InputError as error:
        return replace(result, message="; ".join(filter(None, [result.message, f"no errors are given: {error}"])))


def _measure_maps(planned: PlannedRecording, results: Sequence[MethodResult], notes: list[str]) -> list[MethodResult]:
    """Compare every map with the reference map; remarks are added to the notes."""
    try:
        file = planned.entry.reference_map
        reference = find_reference_map(planned.source) if file is None else load_reference_map(file)
    except InputError as error:
        notes.append(f"no map is compared: {error}")
        return list(results)
    folders = {run.name: run.request.out for run in planned.runs}
    is_method = planned.entry.reference in folders  # whose world is not the reference map's
    measured = []
    for result in results:
        measured.append(result)
        if reference is None or result.trajectory is None:
            continue
        try:
            request = EvaluateRequest(folders[result.name])
            metrics = None if is_method else result.metrics
            compared = evaluate_map(request, read_estimate(request.run), metrics, reference)
        except InputError as error:
            notes.append(f"{result.name}: no map is compared: {error}")
            continue
        notes.extend(f"{result.name}: {warning}" for warning in compared.warnings())
        measured[-1] = replace(result, map_metrics=compared.json, map_errors=compared.errors)
    return measured


_BEST = "*"
# Columns without a value are left out.
_SHOWN = (
    "ate_rotation_rmse_deg",
    "rpe_translation_rmse_m",
    "elapsed_ms_per_scan",
    "latency_ms_p99",
    "peak_rss_mb",
    "map_chamfer_m",
    "lost_scans",
)


def format_result(recording: str, result: MethodResult, reused: bool = False) -> str:
    """One finished method in a line."""
    took = "" if result.wall_s is None else f" in {result.wall_s:.0f} s"
    took = f"{took}, in an earlier comparison" if reused else took
    why = f": {result.message}" if result.message else ""
    return f"{recording} {result.name}: {result.status}{took}{why}"


def format_comparison(comparison: Comparison, out: Path) -> str:
    """The tables, and where to look."""
    return joined(_lines(comparison, out))


def _lines(comparison: Comparison, out: Path) -> Iterator[str]:
    tables = [_table(sequence) for sequence in comparison.sequences]
    for sequence, table in zip(comparison.sequences, tables, strict=True):
        yield from _table_lines(table)
        yield from (f"{result.name}: {result.message}" for result in sequence.methods if result.message)
        for result in sequence.methods:
            own = result.metrics.plugin_lines() if result.metrics is not None else ()
            yield from (f"{result.name}: {name}: {text}" for name, text in own)
        yield from (*sequence.notes, "")
    for table in comparison.tables:
        yield from (*_table_lines(table), "")
    for missing in comparison.missing:
        yield f"left out: {missing.sequence} ({missing.reason})"
    yield from comparison.notes
    if any(table.best() for table in (*tables, *comparison.tables)):
        yield f"{_BEST} best of its column"
    yield f"report    {out / REPORT_HTML}, {out / REPORT_MD}, {out / COMPARISON}"
    runs = [str(out / result.run) for sequence in comparison.sequences[:1] for result in sequence.methods if result.run]
    if runs:
        yield f"look      {command_line(as_typed('lidarslam'), 'view', *runs)}"


def _table(sequence: SequenceComparison) -> Table:
    """The methods on one recording; a run that ended early is not compared with others."""
    results = sequence.methods
    # KITTI's drift, or that over the longest segments for which the recording is long enough.
    drifts = ["kitti_translation_percent", *(f"segment_{each}_translation_percent" for each in SHORT_LENGTHS_M[::-1])]
    drift = next((name for name in drifts if any(QUANTITIES[name].of(result) is not None for result in results)), None)
    quantities = [QUANTITIES[name] for name in ("ate_rmse_m", drift or drifts[0], *_SHOWN)]
    columns = [TableColumn("", "status", numeric=False), *(quantity.column() for quantity in quantities)]
    rows = [TableRow(of.name, [TableCell(of.status), *(each.cell(of) for each in quantities)]) for of in results]
    against = "" if sequence.reference is None else f", against {sequence.reference_name}"
    return Table(f"{sequence.sequence}{against}", columns, rows, times_note(results)).without_empty()


def _table_lines(table: Table) -> Iterator[str]:
    """Lines of columns: words to the left, numbers to the right, the best of a column marked."""
    yield table.title
    best = table.best()
    sources = list(dict.fromkeys(row.source for row in table.rows if row.source))
    marks = [f" [{sources.index(row.source) + 1}]" if row.source else "" for row in table.rows]
    names = ["method", *(f"{row.method}{mark}" for row, mark in zip(table.rows, marks, strict=True))]
    columns = [[name.ljust(max(map(len, names))) for name in names]]
    for number, column in enumerate(table.columns):
        heading = f"{column.heading}: " if column.heading else ""
        texts = [f"{heading}{column.label} {column.unit}".strip() + " " * column.numeric]
        for row, each in enumerate(table.rows):
            cell = each.cells[number]
            text = number_text(cell.value, column.digits)
            mark = (_BEST if (row, number) in best else " ") if column.numeric else ""
            texts.append(f"{text}{mark}{cell.note and f'({cell.note})'}")
        width = max(map(len, texts))
        columns.append([text.rjust(width) if column.numeric else text.ljust(width) for text in texts])
    yield from ("  ".join(cells).rstrip() for cells in zip(*columns, strict=True))
    if table.note:
        yield table.note
    yield from (f"[{number}] {source}" for number, source in enumerate(sources, start=1))


_PROGRAMS = ("lidarslam", "kiss-icp", "numpy", "onnxruntime", "open3d", "open3d-cpu", "torch")


def versions() -> dict[str, str]:
    """Versions of the programs that results depend on, and the commit of a checkout."""
    found = {}
    for name in _PROGRAMS:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    found["python"] = platform.python_version()
    commit = _commit(Path(__file__).resolve().parents[2])
    return found if commit is None else found | {"commit": commit}


def machine() -> dict[str, str]:
    """Processor, cores of this process, memory and system; unknown entries are left out."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    system = f"{platform.system()} {platform.release()} ({platform.machine()})"
    described = {"processor": _processor(), "cores": str(usable_cores()), "memory": f"{memory:.1f} GiB"}
    return {name: text for name, text in (described | {"system": system}).items() if text}


def _commit(folder: Path) -> str | None:
    """The commit of a checkout, marked where files differ from it; None without git or checkout."""
    if not (folder / ".git").exists():
        return None
    command = ["git", "--no-optional-locks", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run([*command, "--exclude=*"], capture_output=True, text=True, timeout=10.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return " ".join(value.split())
    return platform.processor()
