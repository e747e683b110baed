"""What stands between the options of `lidarslam compare` and the comparison."""

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lidarslam.compare.benchmark import load_benchmark
from lidarslam.compare.benchmark_request import fill_request, make_recordings
from lidarslam.compare.comparison import Narrator, compare
from lidarslam.compare.methods import parse_methods
from lidarslam.compare.request import CompareRequest, RecordingEntry
from lidarslam.compare.supervised import Limits
from lidarslam.compare.text import format_comparison
from lidarslam.config.settings import reader_settings
from lidarslam.core.errors import ConfigError
from lidarslam.run.interruption import ended_like_interrupted
from lidarslam.run.progress import show_count

DEFAULT_METHODS = "learned+map,kiss-icp"

Say = Callable[[str], None]


@dataclass(frozen=True)
class CompareOptions:
    """The options as they were given; see `lidarslam compare --help`."""

    sources: tuple[Path, ...]
    benchmark: Path | None
    out: Path
    methods: str | None
    data: Path | None
    prior: Path | None
    reference: str | None
    reference_map: Path | None
    memory_limit_mb: float | None
    timeout_s: float | None
    start: int
    stop: int | None
    step: int
    reuse: bool
    overwrite: bool
    reader: str | None
    topic: str | None
    sequence: str | None
    config_file: Path | None
    settings: tuple[str, ...]


def run_compare(options: CompareOptions, say: Say, tell: Say) -> bool:
    """Compare, and print the tables; whether there is a result, and all of it.

    Args:
        options: of the command.
        say: prints the result.
        tell: prints how it goes.
    """
    request = _request(options)
    with ended_like_interrupted():  # or the methods would outlive a request to end
        if options.benchmark is not None:
            benchmark = load_benchmark(options.benchmark)
            request = fill_request(request, benchmark, options.data)
            make_recordings(benchmark, request, show_count)
        outcome = compare(request, Narrator(show_count, tell))
    say(format_comparison(outcome.comparison, options.out))
    if outcome.is_empty:
        tell("no method came to a result; the table says why")
    return not outcome.interrupted and not outcome.is_empty


def _request(options: CompareOptions) -> CompareRequest:
    names = options.methods or (DEFAULT_METHODS if options.benchmark is None else None)
    if options.reuse and options.overwrite:
        raise ConfigError("--reuse keeps what --overwrite replaces; choose one")
    reader = reader_settings(name=options.reader, topic=options.topic, sequence=options.sequence)
    return CompareRequest(
        out=options.out,
        recordings=tuple(_entry(source, options) for source in options.sources),
        methods=() if names is None else parse_methods(names),
        config_file=options.config_file,
        settings=(*options.settings, *reader),
        limits=Limits(options.memory_limit_mb, options.timeout_s),
        overwrite=options.overwrite,
        reuse=options.reuse,
        command=shlex.join(["lidarslam", *sys.argv[1:]]),
    )


def _entry(source: Path, options: CompareOptions) -> RecordingEntry:
    return RecordingEntry(
        source=source,
        start=options.start,
        stop=options.stop,
        step=options.step,
        prior=options.prior,
        reference=options.reference,
        reference_map=options.reference_map,
    )
