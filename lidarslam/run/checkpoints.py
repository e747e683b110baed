"""Checkpoints of a run: when its state is saved, its content, whether and how a run resumes from it."""

import hashlib
import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.config.settings import CheckpointConfig
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.scan import Scan
from lidarslam.core.state import State, write_state
from lidarslam.core.text import count
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.odometry.interface import Odometry
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run.interruption import Interruptions
from lidarslam.run.request import RunRequest, describe_run, written_request
from lidarslam.run.summary import ScanLog
from lidarslam.storage import directory as files
from lidarslam.storage.directory import RERUN, About, Unfinished
from lidarslam.storage.finished_run import read_summary, where_astray

logger = logging.getLogger(__name__)

# Sections of the configuration that do not change the results.
WITHOUT_EFFECT = {"viewer": True, "checkpoints": True}


def describe_computed(request: RunRequest, recording: Recording) -> dict[str, Any]:
    """Everything that determines the results of a run; weights and prior by a digest of their content."""
    config = request.config
    tree = config.model_dump(mode="json", exclude=WITHOUT_EFFECT)
    if config.odometry.is_learned:
        from lidarslam.odometry.registry import default_weights

        tree["odometry"]["learned"]["weights"] = _digest(config.odometry.learned.weights or default_weights())
    run = describe_run(request) | {"prior": None if request.prior is None else _digest(request.prior)}
    return json.loads(json.dumps({**run, "recording": _fingerprint(recording), **tree}))  # type: ignore[no-any-return]


def lost_when_finished(request: RunRequest) -> bool | None:
    """Whether tracking was lost, where `out` holds this very run, finished; None where it does not.

    InputError where it holds another finished run.
    """
    out = request.out
    if About.read(out) is not None or not (out / files.CONFIG).is_file() or not (out / files.SUMMARY).is_file():
        return None
    try:
        was_run, was = written_request(out, request.config)
        summary = read_summary(out)
        lost = where_astray(summary) is not None
    except (ConfigError, InputError, KeyError, TypeError, ValueError):
        return None
    was_same = was.model_dump(exclude=WITHOUT_EFFECT) == request.config.model_dump(exclude=WITHOUT_EFFECT)
    if was_run != describe_run(request) or not was_same:
        raise InputError(f"{out}: holds another finished run; name another directory, or replace it with --overwrite")
    return lost


def abandoned(out: Path) -> str:
    """The remains of a run that an interruption ended without results, and what to do."""
    if (out / files.STATE).is_file():
        return f"{out}: interrupted, no results were written; continue from the last checkpoint with --resume"
    if (out / files.ABOUT).is_file():
        return f"{out}: interrupted, no results were written and there is no checkpoint yet; repeat with --overwrite"
    return "interrupted; nothing was kept"


def scans_left(scans: Iterator[Scan], held: Scan, odometry: Odometry, saved: State) -> Iterator[Scan]:
    """The scans after the one that was read last, `held`; the odometry is restored.

    The scans before are read again, so that their faults are counted again. An odometry without a state of its own is
    run over them again. InputError where the scan that was read last is not in the recording, or differs.
    """
    if saved["odometry"] is not None:
        odometry.restore(saved["odometry"])
    else:
        logger.warning("the odometry is run again over the scans before %.6f s", held.stamp)
    for scan in scans:
        if saved["odometry"] is None and scan.stamp <= held.stamp:
            odometry.estimate(scan)
        if scan.stamp == held.stamp and np.array_equal(scan.points, held.points):
            return scans
        if scan.stamp > held.stamp:
            break
    raise InputError(
        f"the recording has changed: it has no scan at {held.stamp:.6f} s like the one that was read last;"
        " give the recording that the run was begun with, or begin again with --overwrite"
    )


def _fingerprint(recording: Recording) -> dict[str, Any]:
    """A few numbers that distinguish recordings; fewer of a damaged one."""
    try:
        info = recording.describe()
    except InputError:
        return {"scans": len(recording)}
    return {"scans": info.scans, "first_stamp": info.first_stamp, "duration_s": info.duration_s}


def _digest(path: Path) -> str:
    """Of a file, or of the files of a folder and their names."""
    try:
        if path.is_dir():
            named = [(one.name, _digest(one)) for one in sorted(path.iterdir()) if one.is_file()]
            return hashlib.sha256(json.dumps(named).encode()).hexdigest()
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


# Saving takes at most this share of the time.
_SHARE = 0.02
# The first is saved soon, so that a run that is killed early can be resumed, too.
_FIRST_S = 1.0
# The beginning of the sentence in the summary.
_RESUMED = "the run was resumed "


class Checkpoints:
    """Saves the states of a run, its odometry, log and graph at intervals and at Ctrl-C; a `pipeline.Checkpointer`."""

    def __init__(
        self,
        unfinished: Unfinished,
        config: CheckpointConfig,
        odometry: Odometry,
        log: ScanLog,
        graph: KeyframeGraph | None,
    ) -> None:
        self.interruptions = Interruptions()  # of the run
        self._unfinished, self._config = unfinished, config
        self._odometry, self._log, self._graph = odometry, log, graph
        self._scans = 0  # since the last checkpoint
        self._done = self._asked = time.monotonic()
        self._cost_s: float | None = None  # of the last one

    def is_due(self) -> bool:
        self._scans += 1
        self.interruptions.takes_requests = True  # before the first scan there is nothing to save
        if self.interruptions.is_requested:
            return True
        if self._config.every_scans is not None:
            return self._scans >= self._config.every_scans
        self._asked = time.monotonic()
        interval_s = self._config.interval_s
        wait_s = min(interval_s, _FIRST_S) if self._cost_s is None else max(interval_s, self._cost_s / _SHARE)
        return self._asked - self._done >= wait_s

    def save(self, pipeline: Pipeline) -> None:
        """Save the state of the idle pipeline, log and graph; a failure is a warning; end an interrupted run."""
        try:
            state = {
                "pipeline": pipeline.state(),
                "odometry": self._odometry.state(),
                "graph": None if self._graph is None else self._graph.state(),
                "log": self._log.state(),
            }
            write_state(self._unfinished.run / files.STATE, state)
            logger.info("checkpoint after %s", count(len(self._log), "scan"))
        except (OutputError, OSError) as error:
            logger.info("%s", error)
            self._log.warn(f"a checkpoint could not be saved, so that --resume would go back further: {error}")
        self._scans, self._done = 0, time.monotonic()
        # Waiting for the threads to become idle is part of the cost.
        self._cost_s = self._done - self._asked
        if self.interruptions.is_requested:
            self.interruptions.protect_results()
            raise KeyboardInterrupt

    def begin(self, pipeline: Pipeline, scans: Iterator[Scan], is_recorded: bool) -> Iterator[Scan]:
        """Restore log, pipeline and odometry, and mark the run as running; the remaining scans of all that it takes."""
        saved, self._unfinished.saved = self._unfinished.saved, None  # its arrays are in use now
        if saved is not None:
            self._log.restore(saved["log"])
            pipeline.restore(saved["pipeline"])
            assert pipeline.held is not None  # while a checkpoint is written, the next scan waits
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
