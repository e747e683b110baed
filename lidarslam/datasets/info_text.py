"""Output of `lidarslam info`."""

from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from lidarslam.core.plain_text import one_line
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.recording import RecordingInfo, SeveralTopicsError, Topic
from lidarslam.datasets.registry import open_recording

# Between these a stamp is a date; else it counts from some start.
_EPOCH_FROM_S, _EPOCH_UNTIL_S = 5e8, 5e9


def describe_source(source: Path, config: ReaderConfig) -> str:
    """The contents of a recording; of a bag whose topic is still to be chosen, the topics alone.

    Raises:
        InputError: the source cannot be read.
    """
    try:
        return format_info(source, open_recording(source, config).describe())
    except SeveralTopicsError as error:
        rows = [
            ("source", str(source)),
            ("point clouds", ", ".join(topic.name for topic in error.clouds)),
            ("note", f"Choose one of them with --topic, such as --topic {error.clouds[0].name}"),
        ]
        return _text(rows, error.topics, chosen=None)


def format_info(source: Path, info: RecordingInfo) -> str:
    """A recording's description as aligned lines of text."""
    return _text(list(_rows(source, info)), info.topics, info.topic)


def _text(rows: Sequence[tuple[str, str]], topics: Sequence[Topic], chosen: str | None) -> str:
    width = max(len(name) for name, _ in rows) + 2
    lines = [f"{name:<{width}}{one_line(text)}" for name, text in rows]
    return "\n".join([*lines, *_topic_lines(topics, chosen)])


def _rows(source: Path, info: RecordingInfo) -> Iterator[tuple[str, str]]:
    yield "source", str(source)
    yield "reader", info.reader
    if info.topic is not None:
        yield "topic", info.topic
    yield "scans", f"{info.scans:,}"
    yield "start", _instant(info.first_stamp)
    rate = "" if info.rate_hz is None else f" at {info.rate_hz:.2f} Hz"
    yield "duration", f"{info.duration_s:.1f} s{rate}"
    dropped = f" and {info.first.dropped:,} invalid ones left out" if info.first.dropped else ""
    yield "points", f"{len(info.first):,} in the first scan{dropped}"
    if info.fields:
        yield "fields", ", ".join(f"{field.name} {field.type_name}" for field in info.fields)
    yield "intensity", _intensity(info.first)
    yield "colour", "no" if info.first.colours is None else "yes"
    yield "rings", "no" if info.first.rings is None else "yes"
    yield "point time", _point_time(info)
    yield "ground truth", str(info.ground_truth) if info.ground_truth else "none"
    for note in info.notes:
        yield "note", note


def _instant(stamp: float) -> str:
    if not _EPOCH_FROM_S <= stamp < _EPOCH_UNTIL_S:
        return f"{stamp:.3f} s"
    return f"{datetime.fromtimestamp(stamp, timezone.utc):%Y-%m-%d %H:%M:%S} UTC ({stamp:.3f})"


def _intensity(scan: Scan) -> str:
    known = None if scan.intensities is None else scan.intensities[np.isfinite(scan.intensities)]
    if known is None or not len(known):
        return "no"
    return f"{known.min():.4g} to {known.max():.4g} in the first scan"


def _point_time(info: RecordingInfo) -> str:
    model, offsets = info.point_time, info.first.time_offsets
    if model is None or offsets is None or not len(offsets):
        return "none (scans are taken as motion compensated or at one instant)"
    span = f"{1e3 * offsets.min():+.1f} to {1e3 * offsets.max():+.1f} ms around the stamp"
    return f"{model.field} in {model.unit}, {model.reference}; {span}"


def _topic_lines(topics: Sequence[Topic], chosen: str | None) -> Iterator[str]:
    if not topics:
        return
    yield from ("", "topics")
    names = max(len(one_line(topic.name)) for topic in topics)
    types = max(len(one_line(topic.message_type)) for topic in topics)
    for topic in topics:
        mark = "*" if topic.name == chosen else " "
        yield f"  {mark} {one_line(topic.name):<{names}}  {one_line(topic.message_type):<{types}}  {topic.messages:>8,}"
