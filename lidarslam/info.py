"""What `lidarslam info` prints."""

from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

from lidarslam.datasets.recording import RecordingInfo

# Later than this a stamp is a date; below it counts from some start.
_EPOCH_FROM_S = 5e8


def format_info(source: Path, info: RecordingInfo) -> str:
    """A recording's description as aligned lines of text."""
    rows = list(_rows(source, info))
    width = max(len(name) for name, _ in rows) + 2
    lines = [f"{name:<{width}}{text}" for name, text in rows]
    if info.topics:
        lines += ["", "topics", *_topic_lines(info)]
    return "\n".join(lines)


def _rows(source: Path, info: RecordingInfo) -> Iterator[tuple[str, str]]:
    yield "source", str(source)
    yield "reader", info.reader
    if info.topic is not None:
        yield "topic", info.topic
    yield "scans", f"{info.scans:,}"
    yield "start", _instant(info.first_stamp)
    rate = "" if info.rate_hz is None else f" at {info.rate_hz:.2f} Hz"
    yield "duration", f"{info.duration_s:.1f} s{rate}"
    dropped = f" and {info.dropped_points:,} invalid ones left out" if info.dropped_points else ""
    yield "points", f"{info.points_per_scan:,} in the first scan{dropped}"
    if info.fields:
        yield "fields", ", ".join(f"{field.name} {field.type_name}" for field in info.fields)
    yield "rings", "yes" if info.has_rings else "no"
    yield "point time", _point_time(info)
    yield "ground truth", str(info.ground_truth) if info.ground_truth else "none"
    for note in info.notes:
        yield "note", note


def _instant(stamp: float) -> str:
    if stamp < _EPOCH_FROM_S:
        return f"{stamp:.3f} s"
    return f"{datetime.fromtimestamp(stamp, timezone.utc):%Y-%m-%d %H:%M:%S} UTC ({stamp:.3f})"


def _point_time(info: RecordingInfo) -> str:
    time = info.point_time
    if time is None:
        return "none (scans are taken as motion compensated or at one instant)"
    span = f"{1e3 * time.first_s:+.1f} to {1e3 * time.last_s:+.1f} ms around the stamp"
    return f"{time.source} in {time.unit}, {time.reference}; {span}"


def _topic_lines(info: RecordingInfo) -> Iterator[str]:
    width = max(len(topic.name) for topic in info.topics)
    types = max(len(topic.message_type) for topic in info.topics)
    for topic in info.topics:
        mark = "*" if topic.name == info.topic else " "
        yield f"  {mark} {topic.name:<{width}}  {topic.message_type:<{types}}  {topic.messages:>8,}"
