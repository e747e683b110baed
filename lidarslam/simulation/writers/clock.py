"""What the clock of a recording reads: simulated time starts at zero, the clocks of drivers in 1970."""

# 2024-01-01 00:00:00 UTC. Fixed, so that the same seed gives the same bytes; far from zero, where a reader could not
# tell times that count from the stamp from readings of the clock.
CLOCK_START_NS = 1_704_067_200 * 10**9


def clock_ns(time: float, start_ns: int = CLOCK_START_NS) -> int:
    """The clock's reading at a simulated time in seconds, to the nanosecond."""
    return start_ns + round(time * 1e9)


def clock_s(time: float, start_ns: int = CLOCK_START_NS) -> float:
    """The same in seconds, the float64 that a reader makes of the nanoseconds."""
    return clock_ns(time, start_ns) / 10**9
