"""What is left of a bag whose index is gone: its messages, one after another as they lie in the file.

A recorder that was killed, or a copy that was cut short, leaves no index, and half a chunk at the end. Where there is
an index, and the bag is damaged in the midst, it says where the chunks behind the damage are.
"""

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lidarslam.datasets.bag_database import DatabaseWalk
from lidarslam.datasets.bag_walks import Expand, McapWalk, Rosbag1Walk, SalvagedMessage, Walk

_WALKS: dict[str, type[Walk]] = {".bag": Rosbag1Walk, ".mcap": McapWalk, ".db3": DatabaseWalk}


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


@dataclass(frozen=True)
class Place:
    """Where to go on in a file whose index is known.

    Attributes:
        path, suffix: the file, and which kind it is.
        connections: topic and type of each number that messages carry.
        chunks: where they begin, bytes; none where the file has none.
    """

    path: Path
    suffix: str
    connections: Mapping[int, tuple[str, str]]
    chunks: Sequence[int]


def messages_from(place: Place, expand: Expand, on_damage: Callable[[str], None]) -> Iterator[SalvagedMessage]:
    """The messages in the chunks of a place, or of its whole file where that has none, without those that are damaged.

    Damage is told, but for that of the first chunk: whoever goes on from there knows of it.
    """
    walk = _WALKS[place.suffix](place.path, expand)
    if not place.chunks:
        yield from walk.messages()
        return
    walk.know(place.connections)
    with place.path.open("rb") as file:
        for number, chunk in enumerate(place.chunks):
            walk.damage = None
            file.seek(chunk)
            try:
                yield from walk.record(file, whole=True)
            except Exception as error:  # damaged bytes make struct, codecs and look-ups raise nearly anything
                walk.damaged("it cannot be read", error)
            if walk.damage is not None and number:
                on_damage(f"the chunk at byte {chunk:,}: {walk.damage}")
