"""Going on with a run that was killed or stopped: whether it is the same run, and with which scan it goes on."""

import hashlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.config.settings import Config, read_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved
from lidarslam.datasets.recording import Recording
from lidarslam.resume.unfinished import About
from lidarslam.run import directory as files
from odometry.interface import Odometry

logger = logging.getLogger(__name__)

# Sections of the configuration that change nothing about the results.
_WITHOUT_EFFECT = {"viewer": True, "checkpoints": True}


def describe_computed(config: Config, recording: Recording, run: dict[str, Any], prior: Path | None) -> dict[str, Any]:
    """All that decides what a run computes; files by what they hold.

    Args:
        config: of the run.
        recording: its source, opened.
        run: what config.yaml says of it: version, source, and which scans.
        prior: the file of its prior.

    Raises:
        InputError: a file cannot be read.
    """
    tree = config.model_dump(mode="json", exclude=_WITHOUT_EFFECT)
    if config.odometry.method == "learned":
        from odometry.network.shipped import default_weights

        tree["odometry"]["learned"]["weights"] = _digest(config.odometry.learned.weights or default_weights())
    given = run | {"prior": None if prior is None else _digest(prior)}
    return json.loads(json.dumps({**given, "recording": _fingerprint(recording), **tree}))  # type: ignore[no-any-return]


def astray_before(out: Path, config: Config, run: dict[str, Any]) -> bool | None:
    """Whether tracking was lost in this very run, if a directory holds it with nothing left to do; None if it does not.

    Raises:
        InputError: it holds another one.
    """
    if About.read(out) is not None or not (out / files.CONFIG).is_file() or not (out / files.SUMMARY).is_file():
        return None
    try:
        tree = read_yaml(out / files.CONFIG)
        was_run = tree.pop(files.RUN_SECTION)
        was = Config.model_validate(tree).model_dump(exclude=_WITHOUT_EFFECT)
        summary = json.loads((out / files.SUMMARY).read_text(encoding="utf-8"))
        astray = int(summary["lost_scans"]) > 0 or len(summary.get("map_contradictions", [])) > 0
    except (ConfigError, OSError, KeyError, TypeError, ValueError):
        return None
    if was_run != run or was != config.model_dump(exclude=_WITHOUT_EFFECT):
        raise InputError(
            f"{out}: holds a finished run of something else; name another directory, or replace it with --overwrite"
        )
    return astray


def scans_left(scans: Iterator[Scan], held: Scan, odometry: Odometry, saved: Saved) -> Iterator[Scan]:
    """The scans after the one that was read last, with an odometry that knows of all those before.

    Those before are read again, so that what is wrong with them is counted again.

    Args:
        scans: all that the run takes, from the first on.
        held: the last one that was read.
        odometry: new; takes its state, or where it has none all the scans again.
        saved: with the odometry's state.

    Raises:
        InputError: the scan that was read last is not in the recording, or not what it was.
    """
    if saved.has("odometry"):
        odometry.restore(saved.part("odometry"))
        return _after(scans, held)
    logger.warning("the odometry is run again over the scans before %.6f s", held.stamp)
    return _after(_estimated_again(scans, held, odometry), held)


def _estimated_again(scans: Iterator[Scan], held: Scan, odometry: Odometry) -> Iterator[Scan]:
    for scan in scans:
        if scan.stamp <= held.stamp:
            odometry.estimate(scan)
        yield scan


def _after(scans: Iterator[Scan], held: Scan) -> Iterator[Scan]:
    for scan in scans:
        if scan.stamp == held.stamp and np.array_equal(scan.points, held.points):
            return scans
        if scan.stamp > held.stamp:
            break
    raise InputError(
        f"the recording is not what it was: it has no scan at {held.stamp:.6f} s like the one that was read last;"
        " give that recording, or begin again with --overwrite"
    )


def _fingerprint(recording: Recording) -> dict[str, Any]:
    """A few numbers that tell recordings apart; less of one that is damaged."""
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
