"""Output of `lidarslam info`."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.core.scan import Scan
from lidarslam.core.text import count, one_line
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at
from lidarslam.datasets.recording import ImuSummary, RecordingInfo, SeveralTopicsError, Topic
from lidarslam.datasets.registry import choose_reader, open_recording

# Between these a stamp is a date; else it counts from some start.
_EPOCH_FROM_S, _EPOCH_UNTIL_S = 5e8, 5e9
_KEYS = (
    "topic", "scans", "first_stamp_s", "last_stamp_s", "duration_s", "rate_hz", "first_scan", "point_time",
    "ground_truth", "imu",
)  # fmt: skip
_CHOOSE = "Choose one of them with --topic, such as --topic {}"


def describe_source(source: Path, config: ReaderConfig) -> str:
    """The contents of a recording; of a bag whose topic is still to be chosen, the topics alone."""
    try:
        info = open_recording(source, config).describe()
    except SeveralTopicsError as error:
        rows = [
            ("source", str(source)),
            ("point clouds", ", ".join(topic.name for topic in error.clouds)),
            ("note", _CHOOSE.format(error.clouds[0].name)),
        ]
        return _text(rows, error.topics, chosen=None)
    return _text(list(_rows(source, info)), info.topics, info.topic)


def describe_as_json(source: Path, config: ReaderConfig) -> str:
    """The same as JSON with the keys of docs/command_line.md, all of them always; null for unknown values."""
    content: dict[str, Any] = {"source": str(source), "reader": choose_reader(source, config.name)}
    content |= {**dict.fromkeys(_KEYS), "fields": [], "notes": [], "topics": [], "topic_choices": []}
    try:
        content |= _content(open_recording(source, config).describe())
    except SeveralTopicsError as error:
        content["topics"] = _topics(error.topics)
        content["topic_choices"] = [topic.name for topic in error.clouds]
        content["notes"] = [_CHOOSE.format(error.clouds[0].name)]
    # ASCII, so that no name can steer a terminal; DEL is the one such character that JSON leaves as it is.
    return json.dumps(content, indent=2, allow_nan=False).replace("\x7f", "\\u007f")


def _content(info: RecordingInfo) -> dict[str, Any]:
    first, imu, model = info.first, info.imu, info.point_time
    times = None
    if model is not None and first.time_offsets is not None and len(first):
        span = {"first_s": float(first.time_offsets.min()), "last_s": float(first.time_offsets.max())}
        times = {**asdict(model), **span}
    return {
        "topic": info.topic,
        "scans": info.scans,
        "first_stamp_s": info.first_stamp,
        "last_stamp_s": info.last_stamp,
        "duration_s": info.duration_s,
        "rate_hz": info.rate_hz,
        "first_scan": {
            "points": len(first),
            "dropped_points": first.dropped,
            **{f"has_{name}": getattr(first, name) is not None for name in ("intensities", "colours", "rings")},
        },
        "point_time": times,
        "ground_truth": None if info.ground_truth is None else str(info.ground_truth),
        "fields": [{"name": field.name, "type": field.type_name} for field in info.fields],
        "imu": None if imu is None else {key: value for key, value in asdict(imu).items() if key != "notes"},
        "notes": list(_notes(info)),
        "topics": _topics(info.topics),
    }


def _topics(topics: Sequence[Topic]) -> list[dict[str, Any]]:
    return [{"name": topic.name, "type": topic.message_type, "messages": topic.messages} for topic in topics]


def _text(rows: Sequence[tuple[str, str]], topics: Sequence[Topic], chosen: str | None) -> str:
    width = max(len(name) for name, _ in rows) + 2
    lines = [f"{name:<{width}}{one_line(text)}" for name, text in rows]
    if topics:
        named = [(one_line(topic.name), one_line(topic.message_type)) for topic in topics]
        names, types = (max(map(len, column)) for column in zip(*named, strict=True))
        lines += ["", "topics"]
        lines += [
            f"  {'*' if topic.name == chosen else ' '} {name:<{names}}  {kind:<{types}}  {topic.messages:>8,}"
            for topic, (name, kind) in zip(topics, named, strict=True)
        ]
    return "\n".join(lines)


def _rows(source: Path, info: RecordingInfo) -> Iterator[tuple[str, str]]:
    yield "source", str(source)
    yield "reader", info.reader
    if info.topic is not None:
        yield "topic", info.topic
    yield "scans", f"{info.scans:,}"
    yield "start", _instant(info.first_stamp)
    assumed = "an assumed " if info.rate_is_assumed else ""
    rate = "" if info.rate_hz is None else f" at {assumed}{info.rate_hz:.2f} Hz"
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
    if info.imu is not None:
        yield "imu", _imu(info.imu)
    for note in _notes(info):
        yield "note", note


def _notes(info: RecordingInfo) -> Iterator[str]:
    faults = Faults()
    look_at(info.first, faults)
    yield from (*info.notes, *faults.warnings(), *(info.imu.notes if info.imu else ()))
    if info.imu is not None:
        yield "An IMU is there: run with --odometry learned+imu."


def _instant(stamp: float) -> str:
    if not _EPOCH_FROM_S <= stamp < _EPOCH_UNTIL_S:
        return f"{stamp:.3f} s"
    return f"{datetime.fromtimestamp(stamp, UTC):%Y-%m-%d %H:%M:%S} UTC ({stamp:.3f})"


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


def _imu(imu: ImuSummary) -> str:
    rate = "" if imu.rate_hz is None else f" at {imu.rate_hz:.0f} Hz"
    extrinsic = "extrinsic known" if imu.has_extrinsic else "extrinsic unknown"
    return f"{imu.name}, {count(imu.samples, 'sample')}{rate}, {extrinsic}"
