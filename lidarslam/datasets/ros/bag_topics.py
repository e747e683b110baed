"""Which topic of a bag is the recording, and whether all of it is there."""

from collections.abc import Sequence
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.datasets.recording import SeveralTopicsError, Topic
from lidarslam.datasets.ros.bag_message import CLOUD_TYPES, OUSTER_PACKET_TYPES, VELODYNE_SCAN_TYPE

_PACKET_WORDS = ("packet", "velodynescan", "pandarscan", "rslidarscan")
_TOPICS_LISTED = 20
# Of the messages of one topic, what all others together have at most where they are no recordings: a map now and then.
_NEGLIGIBLE = 0.05


def choose_topic(source: Path, topics: Sequence[Topic], wanted: str | None) -> Topic:
    """The wanted point cloud topic, or the only one with many messages; without clouds, the only one of packets.

    Raises:
        SeveralTopicsError: there is more than one to choose from.
        InputError: there is no such topic, or none to choose from; the message lists them.
    """
    clouds = [topic for topic in topics if topic.message_type in CLOUD_TYPES and topic.messages]
    packets = [topic for topic in topics if _has_packets(topic) and topic.messages]
    if wanted is not None:
        named = [topic for topic in topics if topic.name.lstrip("/") == wanted.lstrip("/")]
        if chosen := next((topic for topic in named if topic in clouds + packets), None):
            return chosen
        found = f"holds {_listing(named)}, which is no point cloud" if named else f"has no topic {wanted!r}"
        raise InputError(f"{source}: {found}; its point cloud topics: {_listing(clouds)}")
    clouds = clouds or packets
    most = max(clouds, key=lambda topic: topic.messages, default=None)
    if most is not None and sum(topic.messages for topic in clouds) <= (1.0 + _NEGLIGIBLE) * most.messages:
        return most
    if clouds:
        message = f"{source}: several point cloud topics, choose one with --topic: {_listing(clouds)}"
        raise SeveralTopicsError(message, clouds, topics)
    if not any(topic.messages for topic in topics):
        raise InputError(f"{source}: the bag is empty, expected messages of a point cloud topic; record it again")
    others = [topic for topic in topics if any(word in topic.message_type.lower() for word in _PACKET_WORDS)]
    hint = (
        " {} holds raw packets of a sensor whose packets are not decoded: play it through the sensor's driver and"
        " record the point clouds."
    )
    raise InputError(
        f"{source}: no point cloud topic (sensor_msgs/PointCloud2 or Livox CustomMsg) with messages."
        f"{hint.format(others[0].name) if others else ''} Its topics: {_listing(topics)}"
    )


def others_left_out(topics: Sequence[Topic], chosen: Topic) -> str | None:
    """A sentence where a bag has point clouds on other topics than the chosen one."""
    others = [t for t in topics if t.message_type in CLOUD_TYPES and t.messages and t.name != chosen.name]
    named = ", ".join(f"{topic.name} ({topic.messages})" for topic in others[:_TOPICS_LISTED])
    return f"{chosen.name} is read; {named} with few messages left out: choose with --topic." if others else None


def _has_packets(topic: Topic) -> bool:
    """Whether a topic holds a sensor's packets that can be decoded."""
    is_lidar = "lidar" in topic.name.rpartition("/")[2]  # packets of the IMU have the same type
    return topic.message_type == VELODYNE_SCAN_TYPE or (topic.message_type in OUSTER_PACKET_TYPES and is_lidar)


def one_part(source: Path) -> str | None:
    """A sentence where a file is one of several of a rosbag2."""
    folder = source.absolute().parent
    if source.is_dir() or not (folder / "metadata.yaml").is_file():
        return None
    parts = len(list(folder.glob(f"*{source.suffix}")))
    return f"This file is one of {parts} parts of the bag {folder}; name the folder for all." if parts > 1 else None


def _listing(topics: Sequence[Topic]) -> str:
    words = [f"{topic.name} ({topic.message_type}, {topic.messages} messages)" for topic in topics[:_TOPICS_LISTED]]
    if len(topics) > _TOPICS_LISTED:
        words.append(f"and {len(topics) - _TOPICS_LISTED} more")
    return ", ".join(words) or "none"
