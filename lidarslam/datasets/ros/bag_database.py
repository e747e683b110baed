"""One pass through the SQLite tables of rosbag2 without their index."""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from urllib.parse import quote

from lidarslam.datasets.ros.bag_walks import SalvagedMessage, Walk

_ROWS = "SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED WHERE id > ? ORDER BY id"


class DatabaseWalk(Walk):
    """The rows of a table in the order they were written, without the index, whose pages lie at the end."""

    def messages(self) -> Iterator[SalvagedMessage]:
        uri = f"file:{quote(str(self._path.absolute()))}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            # Without it SQLite refuses a file that is shorter than its header says; nothing can be written here.
            database.execute("PRAGMA writable_schema=ON")
            topics = {row[0]: (row[1], row[2]) for row in database.execute("SELECT id, name, type FROM topics")}
            held, is_cut = None, self._is_cut()
            for topic, record_ns, raw in self._rows(database):
                if held is not None:
                    yield held
                    held = None
                try:
                    if not isinstance(raw, bytes):  # of a number, bytes() makes as many zeros
                        raise TypeError(f"its data are of type {type(raw).__name__}")
                    message = SalvagedMessage(*topics[topic], int(record_ns), raw)
                except (KeyError, TypeError, ValueError) as error:
                    self.damaged("a row of it is no message", error)
                    continue
                if is_cut:  # of the last one SQLite may have made up the end, from zeros
                    held = message
                else:
                    yield message

    def _is_cut(self) -> bool:
        """Whether pages are missing at the end (sqlite.org/fileformat2.html, 1.3)."""
        with self._path.open("rb") as file:
            header = file.read(32)
        (page,), (pages,) = struct.unpack_from(">H", header, 16), struct.unpack_from(">I", header, 28)
        return bool(self._path.stat().st_size < pages * (65536 if page == 1 else page))

    def _rows(self, database: sqlite3.Connection) -> Iterator[tuple[int, int, object]]:
        """Past pages that are damaged, row by row, as far as the table goes."""
        done, last, lost = -1, None, 0
        first: tuple[int, sqlite3.Error] | None = None
        while last is None or done < last:
            try:
                for number, topic, record_ns, raw in database.execute(_ROWS, (done,)):
                    yield topic, record_ns, raw
                    done = number
                break
            except sqlite3.Error as error:
                first = first or (done, error)
            try:
                (last,) = database.execute("SELECT max(id) FROM messages").fetchone()
            except sqlite3.Error:  # its end is gone too
                self.damaged(f"it breaks off after row {done:,}", first[1])
                return
            done, lost = done + 1, lost + 1
        if first is not None:
            self.damaged(f"{lost:,} rows of it cannot be read, the first after row {first[0]:,}", first[1])
