"""Checkpoints of a run: when its state is saved, what it consists of, how a run goes on from it."""

import logging
import time
from collections.abc import Iterator

from lidarslam.config.settings import CheckpointConfig
from lidarslam.core.errors import OutputError
from lidarslam.core.scan import Scan
from lidarslam.core.text.plain_text import count
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.odometry.interface import Odometry
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run.resuming import scans_left
from lidarslam.run.scan_log import ScanLog
from lidarslam.storage.directory import RERUN
from lidarslam.storage.state_file import write_state
from lidarslam.storage.unfinished import Unfinished

logger = logging.getLogger(__name__)

# Saving takes at most this share of the time.
_SHARE = 0.02
# The first is saved soon, so that a run that is interrupted early can go on, too.
_FIRST_S = 1.0
# How the sentence in the summary begins.
_RESUMED = "the run was resumed "


class Checkpoints:
    """Saves the state of a run now and then; see `lidarslam.pipeline.pipeline.Checkpointer`.

    Args:
        unfinished: where.
        config: how often.
        odometry, log, graph: of the run, saved with the pipeline.
    """

    def __init__(
        self,
        unfinished: Unfinished,
        config: CheckpointConfig,
        odometry: Odometry,
        log: ScanLog,
        graph: KeyframeGraph | None,
    ) -> None:
        self._unfinished = unfinished
        self._config = config
        self._odometry = odometry
        self._log = log
        self._graph = graph
        self._scans = 0  # since the last checkpoint
        self._done = self._asked = time.monotonic()
        self._cost_s: float | None = None  # of the last one

    def is_due(self) -> bool:
        """Whether it is time."""
        self._scans += 1
        if self._config.every_scans is not None:
            return self._scans >= self._config.every_scans
        self._asked = time.monotonic()
        interval_s = self._config.interval_s
        wait_s = min(interval_s, _FIRST_S) if self._cost_s is None else max(interval_s, self._cost_s / _SHARE)
        return self._asked - self._done >= wait_s

    def save(self, pipeline: Pipeline) -> None:
        """Save the state of the pipeline, which is at rest, log and graph; a failure is a warning."""
        try:
            state = {
                "pipeline": pipeline.state(),
                "odometry": self._odometry.state(),
                "graph": None if self._graph is None else self._graph.state(),
                "log": self._log.state(),
            }
            write_state(self._unfinished.files.state, state)
            logger.info("checkpoint after %s", count(len(self._log), "scan"))
        except (OutputError, OSError) as error:
            logger.info("%s", error)
            self._log.warn(f"a checkpoint could not be saved, so that --resume would go back further: {error}")
        self._scans, self._done = 0, time.monotonic()
        # Waiting for the threads to come to rest is part of the cost.
        self._cost_s = self._done - self._asked

    def begin(self, pipeline: Pipeline, scans: Iterator[Scan], is_recorded: bool) -> Iterator[Scan]:
        """Restore log, pipeline and odometry, and mark the run as being at work; the scans that are left.

        Args:
            pipeline: new.
            scans: all that the run takes.
            is_recorded: whether a Rerun recording is written.

        Raises:
            InputError: the checkpoint is damaged, or the recording is another one.
        """
        saved, self._unfinished.saved = self._unfinished.saved, None  # its arrays are in use now
        if saved is not None:
            self._log.restore(saved.part("log"))
            pipeline.restore(saved.part("pipeline"))
            if pipeline.held is None:
                raise saved.refuse("no scan is held")
            graph = len(self._log) if self._graph is None else len(self._graph.scan_poses)
            if not len(self._log) == pipeline.map.scans == graph:
                raise saved.refuse(f"{len(self._log)} scans in the log, {pipeline.map.scans} in the map, {graph} poses")
            scans = scans_left(scans, pipeline.held.scan, self._odometry, saved)
        self._unfinished.begin(len(self._log))
        self._warn_of_resuming(saved is None, is_recorded)
        return scans

    def _warn_of_resuming(self, from_start: bool, is_recorded: bool) -> None:
        resumed = self._unfinished.about.resumed_after
        if not resumed:
            return
        if from_start:
            logger.warning("%s: there is no checkpoint yet; the run begins from the start", self._unfinished.run)
        elif is_recorded:
            self._log.warn(f"{RERUN} holds the scans from {len(self._log)} on; lidarslam view shows the whole run")
        times = "once" if len(resumed) == 1 else f"{len(resumed)} times"
        after = ", ".join(map(str, resumed))
        self._log.warnings = [warning for warning in self._log.warnings if not warning.startswith(_RESUMED)]
        self._log.warn(f"{_RESUMED}{times}, after {after} scans; peak memory is that of the last part")
