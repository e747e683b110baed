"""Which of a bag message's two times is the scan's stamp: the header's, unless the driver never sets it anew."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

from lidarslam.datasets.ros.bag_file import BagMessage

_MESSAGES_LOOKED_AT = 10
# More equal stamps than this in a row are no measured times.
_FEW = 3
# Stamps beyond this (1973) read a clock, and a zero among them was never set; simulated time starts at zero.
_CLOCK_NS = 10**17


@dataclass(frozen=True)
class StampSource:
    """How the messages of one topic are stamped.

    Attributes:
        from_header: the stamps are those of the headers, else the times of recording.
        before_first: stamps up to this one, seconds, are no stamps.
    """

    from_header: bool
    before_first: float

    def stamp(self, message: BagMessage) -> float:
        """The stamp in seconds."""
        return (message.header_ns if self.from_header else message.record_ns) / 10**9


def find_stamp_source(messages: Iterable[BagMessage]) -> StampSource:
    """Decide by the first few messages of a topic."""
    stamps_ns = [message.header_ns for message in islice(messages, _MESSAGES_LOOKED_AT)]
    first_ns = next((stamp_ns for stamp_ns in stamps_ns if stamp_ns), None)
    if first_ns is None or (len(stamps_ns) > _FEW and len(set(stamps_ns)) == 1):
        return StampSource(from_header=False, before_first=-math.inf)
    return StampSource(from_header=True, before_first=0.0 if first_ns > _CLOCK_NS else -math.inf)
