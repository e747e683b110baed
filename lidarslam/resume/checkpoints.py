"""When a run saves its state, and what that is made of."""

import logging
import time
from collections.abc import Callable

from lidarslam.core.errors import OutputError
from lidarslam.core.state import State
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.resume.config import CheckpointConfig
from lidarslam.resume.state_file import write_state
from lidarslam.resume.unfinished import Unfinished

logger = logging.getLogger(__name__)


class Checkpoints:
    """Saves the state of a run now and then; see `lidarslam.pipeline.pipeline.Keeper`.

    Args:
        unfinished: where.
        config: how often.
        rest: the state of what is not the pipeline's.
        warn: told when it cannot be written; the run goes on.
    """

    def __init__(
        self, unfinished: Unfinished, config: CheckpointConfig, rest: Callable[[], State], warn: Callable[[str], None]
    ) -> None:
        self._file = unfinished.state
        self._config = config
        self._rest = rest
        self._warn = warn
        self._scans = 0  # since the last one
        self._done = self._asked = time.monotonic()
        self._cost_s = 0.0

    def is_due(self) -> bool:
        """Whether it is time."""
        self._scans += 1
        if self._config.every_scans is not None:
            return self._scans >= self._config.every_scans
        self._asked = time.monotonic()
        share = self._config.most_percent / 100.0
        return self._asked - self._done >= max(self._config.interval_s, self._cost_s / share)

    def keep(self, pipeline: Pipeline) -> None:
        """Save the state of a pipeline at rest, and all else."""
        try:
            write_state(self._file, {"pipeline": pipeline.state(), **self._rest()})
        except (OutputError, OSError) as error:
            logger.info("%s", error)
            self._warn(f"the state could not be saved, so that --resume would go back further: {error}")
        self._scans, self._done = 0, time.monotonic()
        # Waiting until all was at rest is part of what it costs.
        self._cost_s = self._done - self._asked
