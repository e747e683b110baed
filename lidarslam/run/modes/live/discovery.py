"""The topic of a live run, once it is published."""

import logging
import time
from collections.abc import Callable, Iterable
from typing import Protocol, TypeVar

from lidarslam.core.errors import InputError
from lidarslam.datasets.ros.bag_message import CLOUD_TYPES

logger = logging.getLogger(__name__)

# Discovery of a running system is done within a second or two; after the second span the topics seen are printed.
_SETTLED_S, _PATIENCE_S, _POLL_S = 2.0, 5.0, 0.1


class Published(Protocol):
    """A topic that is published."""

    @property
    def name(self) -> str:
        """As in ROS."""

    @property
    def message_type(self) -> str:
        """As in ROS."""


P = TypeVar("P", bound=Published)


def find_topic(
    published: Callable[[], Iterable[P]], wanted: str | None, domain: int, within_s: float | None = None
) -> P:
    """Wait for the publisher of a topic of clouds, so long at most; without a name, for the only one.

    Raises:
        InputError: there are several and none is named, the named one holds no clouds, or none came in time.
    """
    begin = time.monotonic()
    is_told = False
    while True:
        topics = list(published())
        waited_s = time.monotonic() - begin
        if wanted is not None and (found := [topic for topic in topics if topic.name == wanted]):
            return _only_clouds(found[0])
        clouds = [topic for topic in topics if topic.message_type in CLOUD_TYPES]
        if wanted is None and clouds and waited_s > _SETTLED_S:
            return _only(clouds)
        if waited_s > _PATIENCE_S and not is_told:
            logger.warning(_what_is_seen(wanted, clouds, len(topics), domain))
            is_told = True
        if within_s is not None and waited_s > within_s:
            raise InputError(f"{within_s:g} s are over, {_what_is_seen(wanted, clouds, len(topics), domain)}")
        time.sleep(_POLL_S)


def _only_clouds(topic: P) -> P:
    if topic.message_type not in CLOUD_TYPES:
        raise InputError(f"{topic.name}: holds {topic.message_type}, not one of {', '.join(CLOUD_TYPES)}")
    return topic


def _only(clouds: list[P]) -> P:
    if len(clouds) > 1:
        names = ", ".join(topic.name for topic in clouds)
        raise InputError(f"clouds are published on {names}; choose one with --topic")
    return clouds[0]


def _what_is_seen(wanted: str | None, clouds: Iterable[Published], topics: int, domain: int) -> str:
    names = ", ".join(topic.name for topic in clouds)
    if names:
        seen = f"clouds are published on {names}"
    elif topics:
        seen = f"{topics} topics are published, none of them with clouds"
    else:
        seen = "no ROS 2 topic is published at all: check ROS_DOMAIN_ID, and the network interface (CYCLONEDDS_URI)"
    return f"waiting for {wanted or 'clouds'} in domain {domain}; {seen}"
