"""Whether a run may be resumed, and with which scan it goes on."""

import hashlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.scan import Scan
from lidarslam.core.state.stateful import Saved
from lidarslam.datasets.recording import Recording
from lidarslam.odometry.interface import Odometry
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.storage import directory as files
from lidarslam.storage.about import About
from lidarslam.storage.summary_file import is_unconstrained, read_summary

logger = logging.getLogger(__name__)

# Sections of the configuration that do not change the results.
WITHOUT_EFFECT = {"viewer": True, "checkpoints": True}


def describe_computed(request: RunRequest, recording: Recording) -> dict[str, Any]:
    """Everything that decides what a run computes; weights and prior by a digest of their content.

    Raises:
        InputError: a file cannot be read.
    """
    config = request.config
    tree = config.model_dump(mode="json", exclude=WITHOUT_EFFECT)
    if config.odometry.is_learned:
        from lidarslam.odometry.network.shipped import default_weights

        tree["odometry"]["learned"]["weights"] = _digest(config.odometry.learned.weights or default_weights())
    run = describe_run(request) | {"prior": None if request.prior is None else _digest(request.prior)}
    return json.loads(json.dumps({**run, "recording": _fingerprint(recording), **tree}))  # type: ignore[no-any-return]


def lost_when_finished(request: RunRequest) -> bool | None:
    """Whether tracking was lost, if `out` holds this very run and it is finished; None if it is not.

    Raises:
        InputError: it holds another finished run.
    """
    out = request.out
    if About.read(out) is not None or not (out / files.CONFIG).is_file() or not (out / files.SUMMARY).is_file():
        return None
    try:
        tree = read_yaml(out / files.CONFIG)
        was_run = tree.pop(files.RUN_SECTION)
        was = Config.model_validate(tree).model_dump(exclude=WITHOUT_EFFECT)
        summary = read_summary(out)
        lost = summary["lost_scans"] > 0 or len(summary.get("map_contradictions", [])) > 0
        lost |= is_unconstrained(summary.get("unconstrained_m", 0.0), summary.get("length_m", 0.0))
    except (ConfigError, InputError, KeyError, TypeError, ValueError):
        return None
    if request.config.reader.elevation_correction_deg == "auto":
        was["reader"]["elevation_correction_deg"] = "auto"  # config.yaml has what was found
    if was_run != describe_run(request) or was != request.config.model_dump(exclude=WITHOUT_EFFECT):
        raise InputError(f"{out}: holds another finished run; name another directory, or replace it with --overwrite")
    return lost


def abandoned(out: Path) -> str:
    """What is left of a run that an interruption ended without results, and what to do."""
    if (out / files.STATE).is_file():
        return f"{out}: interrupted, no results were written; continue from the last checkpoint with --resume"
    if (out / files.ABOUT).is_file():
        return f"{out}: interrupted, no results were written and there is no checkpoint yet; repeat with --overwrite"
    return "interrupted; nothing was kept"


def scans_left(scans: Iterator[Scan], held: Scan, odometry: Odometry, saved: Saved) -> Iterator[Scan]:
    """The scans after the one that was read last; the odometry is restored.

    The scans before are read again, so that their faults are counted again. An odometry without a state of its own is
    run over them again.

    Args:
        scans: all that the run takes, from the first on.
        held: the last one that was read.
        odometry: new.
        saved: with the state of the odometry.

    Raises:
        InputError: the scan that was read last is not in the recording, or differs.
    """
    if saved.has("odometry"):
        odometry.restore(saved.part("odometry"))
    else:
        logger.warning("the odometry is run again over the scans before %.6f s", held.stamp)
    for scan in scans:
        if not saved.has("odometry") and scan.stamp <= held.stamp:
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
