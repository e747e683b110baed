"""A recording in several bags of one folder, as recorders split it."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from heapq import merge
from operator import itemgetter
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.core.text import first_few
from lidarslam.datasets.recording import ROSBAG1_SUFFIXES, STORAGE_SUFFIXES, Topic, storage_files
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_message import CLOUD_TYPES, OUSTER_PACKET_TYPES, VELODYNE_SCAN_TYPE, BagMessage

_LIDAR_TYPES = (*CLOUD_TYPES, *OUSTER_PACKET_TYPES, VELODYNE_SCAN_TYPE)
# A recorder that splits continues at once; what begins later than this is another drive.
_LONGEST_PAUSE_S = 60.0


def open_bag(source: Path) -> BagFile:
    """Open a file, a rosbag2 folder by its metadata, or else all bags of a folder as parts of one recording."""
    try:
        return BagFile(source)
    except InputError as error:
        files = storage_files(source, (*ROSBAG1_SUFFIXES, *STORAGE_SUFFIXES)) if source.is_dir() else []
        if not files:
            raise
        return SplitBag(source, files, f"{error}; its files were read without its metadata.yaml")


class SplitBag(BagFile):
    """The files of one recording; those that cannot be read are left out, as `damage` says."""

    def __init__(self, folder: Path, files: Sequence[Path], no_metadata: str) -> None:
        self.path, self.ros2 = folder, files[0].suffix in STORAGE_SUFFIXES
        parts, errors = list[BagFile](), list[InputError]()
        for file in files:
            try:
                parts.append(BagFile(file))
            except InputError as error:
                errors.append(error)
        if not parts:
            raise errors[0]
        self._parts = sorted(parts, key=lambda part: part.span_ns)
        names = first_few([part.path.name for part in self._parts], 5)
        if (why := self._why_not_one()) is not None:
            raise InputError(f"{folder}: its bags are not one recording: {why}; name one of {names}")
        self.notes = (f"These bags are read as one recording: {names}.",) if len(parts) > 1 else ()
        parts_damage = [part.damage for part in self._parts] + [f"left out: {error}" for error in errors]
        self.damage = "; ".join(filter(None, [no_metadata if self.ros2 else None, *parts_damage])) or None
        counts: Counter[tuple[str, str]] = Counter()
        for topic in (topic for part in parts for topic in part.topics):
            counts[topic.name, topic.message_type] += topic.messages
        self.topics = tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def _why_not_one(self) -> str | None:
        if any(part.ros2 != self.ros2 for part in self._parts):
            return "some are of ROS 1, some of ROS 2"
        parts = [part for part in self._parts if part.span_ns[1]]  # with messages
        for number, part in enumerate(parts[1:], 1):
            begin_ns = part.span_ns[0]
            for other in parts[:number]:
                if 2 * begin_ns < sum(other.span_ns) and _lidar_topics(part) & _lidar_topics(other):
                    return f"{other.path.name} and {part.path.name} have scans of the same time"
            before = max(parts[:number], key=lambda part: part.span_ns[1])
            pause_s = (begin_ns - before.span_ns[1]) / 1e9
            if pause_s > _LONGEST_PAUSE_S and before.damage is None:  # the end of a damaged one is missing
                return f"{part.path.name} begins {pause_s:,.0f} s after the end of {before.path.name}"
        return None

    def messages(self, topic: Topic, on_damage: Callable[[str], None] = lambda _: None) -> Iterator[BagMessage]:
        """All messages of a topic in the order of recording; a file is opened when its time has come."""

        def timed(part: BagFile) -> Iterator[tuple[int, BagMessage | None]]:
            yield part.span_ns[0], None
            for message in part.messages(topic, on_damage):
                yield message.record_ns, message

        merged = merge(*map(timed, self._parts), key=itemgetter(0))
        return (message for _, message in merged if message is not None)

    def last_message(self, topic: Topic) -> BagMessage | None:
        """That of the last file with any."""
        return next(filter(None, (part.last_message(topic) for part in reversed(self._parts))), None)


def _lidar_topics(part: BagFile) -> set[str]:
    return {topic.name for topic in part.topics if topic.messages and topic.message_type in _LIDAR_TYPES}
