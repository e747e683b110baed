"""What is left of a bag whose index is gone: its messages, one after another as they lie in the file.

A recorder that was killed, or a copy that was cut short, leaves no index, and half a chunk at the end. Where there is
an index, and the bag is damaged in the midst, it says where the chunks behind the damage are.
"""

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count
from pathlib import Path
from typing import NamedTuple

from lidarslam.datasets.ros.bag_database import DatabaseWalk
from lidarslam.datasets.ros.bag_walks import Expand, McapWalk, Rosbag1Walk, SalvagedMessage, Walk

_WALKS: dict[str, type[Walk]] = {".bag": Rosbag1Walk, ".mcap": McapWalk, ".db3": DatabaseWalk}

# Where all chunks of a bag overlap in time, order is not worth holding more of it in memory.
_MOST_HELD = 100


class Salvage:
    """The messages of a `.bag`, `.mcap` or `.db3` file up to where it is damaged.

    Attributes:
        counts: how many there are, by topic and type.
        damage: what is wrong with the file; None when all of it could be read.
    """

    def __init__(self, path: Path, suffix: str, expand: Expand) -> None:
        """Read the file once.

        Raises:
            ValueError, OSError, sqlite3.Error: it is no such file at all.
        """
        self._path = path
        self._walk = _WALKS[suffix]
        self._expand = expand
        walk = self._walk(path, expand)
        self.counts = Counter((message.topic, message.message_type) for message in walk.messages())
        self.damage = walk.damage

    def messages(self, topic: str, message_type: str) -> Generator[SalvagedMessage, None, None]:
        """The messages of one topic in the order they lie in the file, which is about that of recording."""
        for message in self._walk(self._path, self._expand).messages():
            if (message.topic, message.message_type) == (topic, message_type):
                yield message


class Chunk(NamedTuple):
    """A chunk that the index knows; the earlier is the smaller.

    Attributes:
        start_ns: when its first message was recorded, or earlier, nanoseconds.
        begin: where it begins, bytes.
    """

    start_ns: int
    begin: int


@dataclass(frozen=True)
class Place:
    """Where to go on in a file whose index is known.

    Attributes:
        path, suffix: the file, and which kind it is.
        connections: topic and type of each number that messages carry.
        chunks: those to read; None where the file has none and is read whole.
    """

    path: Path
    suffix: str
    connections: Mapping[int, tuple[str, str]]
    chunks: Sequence[Chunk] | None


def messages_from(
    place: Place, named: tuple[str, str], expand: Expand, on_damage: Callable[[str], None]
) -> Iterator[SalvagedMessage]:
    """The messages of one topic and type at a place, without those that are damaged.

    Those in chunks come in the order they were recorded, as an index would give them: recorders may write chunks in
    another. All damage is told, once for each chunk.
    """
    walk = _WALKS[place.suffix](place.path, expand)
    if place.chunks is None:
        try:
            yield from (message for message in walk.messages() if (message.topic, message.message_type) == named)
        except Exception as error:  # not even its beginning makes sense
            walk.damaged("it cannot be read", error)
        if walk.damage is not None:
            on_damage(walk.damage)
        return
    walk.know(place.connections)
    with place.path.open("rb") as file:

        def read(chunk: Chunk) -> Iterator[SalvagedMessage]:
            walk.damage = None
            file.seek(chunk.begin)
            try:
                for message in walk.record(file, whole=True):
                    if (message.topic, message.message_type) == named:
                        yield message
            except Exception as error:  # damaged bytes make struct, codecs and look-ups raise nearly anything
                walk.damaged("it cannot be read", error)
            if walk.damage is not None:
                on_damage(f"the chunk at byte {chunk.begin:,}: {walk.damage}")

        yield from _in_order(sorted(place.chunks), read)


def _in_order(chunks: Sequence[Chunk], read: Callable[[Chunk], Iterator[SalvagedMessage]]) -> Iterator[SalvagedMessage]:
    """What is in chunks, merged by time; chunks are read when one of their messages may be the next."""
    unread, numbers = deque(chunks), count()
    held: list[tuple[int, int, SalvagedMessage]] = []
    while unread or held:
        while unread and (not held or (unread[0].start_ns <= held[0][0] and len(held) < _MOST_HELD)):
            for message in read(unread.popleft()):
                heappush(held, (message.record_ns, next(numbers), message))
        if held:
            yield heappop(held)[-1]
