"""Preparation of recordings side by side: each piece is a task that leaves its file in the cache."""

import contextlib
import signal
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from lidarslam.core.errors import OutputError
from lidarslam.core.tasks.start import open_tasks
from lidarslam.core.tasks.tasks import Where
from lidarslam.odometry.training.config import TrainingConfig
from lidarslam.run.progress import show_count
from lidarslam.train.data import Stretch, file_of, prepared_piece


def prepare_side_by_side(stretches: Sequence[Stretch], config: TrainingConfig, cache: Path, where: Where) -> None:
    """Prepare the stretches into the cache, where they are not in it already.

    Raises:
        InputError: a recording turns out unreadable.
        OutputError: the cache cannot be written, or is another folder on the nodes of a cluster.
        KeyboardInterrupt: Ctrl-C; what is finished stays in the cache.
    """
    pieces = [piece for stretch in stretches for piece in stretch.pieces()]
    wanted = [piece for piece in pieces if not file_of(piece, config, cache).is_file()]
    done, total = 0, sum(map(len, wanted))

    def count(index: int, _: object) -> None:
        nonlocal done
        done += len(wanted[index])
        show(done, total)

    prepare_one = partial(_prepare_one, config=config, cache=cache.absolute())
    with show_count("preparing side by side") as show, _interrupted_at_once(), open_tasks(where) as tasks:
        for _ in tasks.run(prepare_one, wanted, count):
            pass
    if not all(file_of(piece, config, cache).is_file() for piece in wanted):
        raise OutputError(f"{cache}: is not shared by the nodes of the cluster; name a folder that is with --prepared")


def _prepare_one(piece: Stretch, config: TrainingConfig, cache: Path) -> None:
    prepared_piece(piece, config, cache, lambda _: None)


@contextlib.contextmanager
def _interrupted_at_once() -> Iterator[None]:
    """For the time of the block, a training's first Ctrl-C ends it; a request that is ignored stays ignored."""
    if threading.current_thread() is not threading.main_thread():  # signals go to the main thread
        yield
        return
    asking = [n for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is not signal.SIG_IGN]
    earlier = [(number, signal.signal(number, signal.default_int_handler)) for number in asking]
    try:
        yield
    finally:
        for number, handler in earlier:
            signal.signal(number, handler)
