"""What a network is trained on: recordings and simulations, made ready once and kept on disk."""

import hashlib
import json
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.scan import Scan, ScanSequence
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import open_recording
from lidarslam.pipeline.scan_stream import in_order
from lidarslam.simulation.recording.mixture import MIXED_WORLDS, SENSOR_WEIGHTS, Ingredients, ingredients_of, mixture
from lidarslam.train.config import SimulatedConfig
from lidarslam.train.teacher import MapTeacher
from odometry.network.tensor_file import Kind, read_tensor_file, write_tensor_file
from odometry.training.preparation import PreparedRecording, prepare
from odometry.training.torch_images import RecordedImages
from odometry.training.training_config import TrainingConfig

# Scans that are held in memory as full images at a time; a longer recording becomes several.
PIECE = 500
# To be raised whenever preparation, or the simulation, computes something else than before.
_KIND = Kind("a recording prepared for training", version=2)
_SWEEP = ("points", "normals", "offsets", "low", "high")
_MOTIONS = ("interval_s", "T_prev_curr", "believed", "explained")

Counter = Callable[[int], None]
"""Told of scans that are ready, how many more."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Some consecutive scans of a recording that is opened when it is needed.

    Attributes:
        name: of the recording.
        identity: what tells it from any other, and from itself before it was changed; values that JSON can hold.
        open: gives its scans.
        first, stop: which of them, as in `range`.
    """

    name: str
    identity: dict[str, Any]
    open: Callable[[], ScanSequence]
    first: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def is_simulated(self) -> bool:
        """Whether it is of the mixture that training draws, and not a recording that was named."""
        return "simulated" in self.identity

    def pieces(self) -> Iterator["Stretch"]:
        """The same scans in parts of about equal length, none longer than `PIECE`."""
        count = -(-len(self) // PIECE)
        borders = [self.first + number * len(self) // count for number in range(count + 1)]
        for first, stop in pairwise(borders):
            yield replace(self, first=first, stop=stop)


def recorded(source: Path, reader: ReaderConfig) -> Stretch:
    """All of a recording.

    Raises:
        InputError: it cannot be read, or has fewer than two scans.
    """
    recording = open_recording(source, reader)
    if len(recording) < 2:
        raise InputError(f"{source}: training needs pairs of scans, this recording has {len(recording)}")
    identity = {
        "source": str(source.resolve()),
        "files": _fingerprint(source),
        "reader": reader.model_dump(mode="json"),
    }
    return Stretch(recording.name, identity, lambda: recording, 0, len(recording))


def simulated(config: SimulatedConfig) -> list[Stretch]:
    """The simulated recordings; their worlds are built when they are needed.

    Raises:
        ConfigError: a world or sensor that they are to be of is not in the mixture, or there is none of that kind.
    """
    _require_known("simulated.worlds", config.worlds, MIXED_WORLDS)
    _require_known("simulated.sensors", config.sensors, SENSOR_WEIGHTS)
    chosen = [number for number in range(config.recordings) if _is_wanted(ingredients_of(number, config.seed), config)]
    if config.recordings and not chosen:
        raise ConfigError(
            f"simulated.recordings={config.recordings}: none is of the worlds and sensors asked for; ask for more"
        )
    return [_simulation(number, config) for number in chosen]


def _require_known(key: str, names: Iterable[str] | None, known: Iterable[str]) -> None:
    for name in names or ():
        if name not in known:
            raise ConfigError(f"{key}: there is no {name!r}; choose from {', '.join(known)}")


def _is_wanted(of: Ingredients, config: SimulatedConfig) -> bool:
    in_world = config.worlds is None or of.world in config.worlds
    return in_world and (config.sensors is None or of.sensor in config.sensors)


def _simulation(number: int, config: SimulatedConfig) -> Stretch:
    identity = {"simulated": number, "seed": config.seed, "scans": config.scans}

    def build() -> ScanSequence:
        return next(mixture(1, config.scans, config.seed, number))

    return Stretch(f"simulation {number}", identity, build, 0, config.scans)


def hold_out(stretches: Sequence[Stretch], share: float, seed: int) -> tuple[list[Stretch], list[Stretch]]:
    """What is learned from, and what is kept for validation: whole recordings, or the end of the only one.

    Raises:
        InputError: the only recording is too short to be divided.
    """
    if not share:
        return list(stretches), []
    if len(stretches) > 1:
        count = min(max(1, round(share * len(stretches))), len(stretches) - 1)
        held = set(random.Random(seed).sample(range(len(stretches)), count))
        return [s for i, s in enumerate(stretches) if i not in held], [stretches[i] for i in sorted(held)]
    only = stretches[0]
    border = only.stop - max(2, round(share * len(only)))
    if border - only.first < 2:
        raise InputError(
            f"{only.name}: {len(only)} scans are too few to learn from some and validate on others;"
            " add a recording, or set training.hold_out=0"
        )
    return [replace(only, stop=border)], [replace(only, first=border)]


def draw_weights(stretches: Sequence[Stretch], recorded_share: float) -> list[float]:
    """How often each prepared recording is drawn, relative to the others, in the order of `prepared`.

    Where there are simulated recordings beside, the others have the given share together, by their numbers of scans.
    """
    pieces = [piece for stretch in stretches for piece in stretch.pieces()]
    recorded_scans = sum(len(piece) for piece in pieces if not piece.is_simulated)
    simulated_count = sum(piece.is_simulated for piece in pieces)
    if not recorded_scans or not simulated_count:
        return [1.0] * len(pieces)
    return [
        (1.0 - recorded_share) / simulated_count if piece.is_simulated else recorded_share * len(piece) / recorded_scans
        for piece in pieces
    ]


def prepared(
    stretches: Sequence[Stretch], config: TrainingConfig, cache: Path, count: Counter
) -> list[PreparedRecording]:
    """The stretches made ready for training, from the cache where they lie in it already.

    Raises:
        InputError: a recording turns out unreadable.
        OutputError: the cache cannot be written.
    """
    return [_prepared(piece, config, cache, count) for stretch in stretches for piece in stretch.pieces()]


def _prepared(piece: Stretch, config: TrainingConfig, cache: Path, count: Counter) -> PreparedRecording:
    key = {**piece.identity, "first": piece.first, "stop": piece.stop, "images": config.images.model_dump(mode="json")}
    if not piece.is_simulated:
        key["teacher"] = config.teacher
    path = cache / f"{_digest(key)}.safetensors"
    try:
        kept = _read(path)
    except InputError:  # not there yet, or damaged: made anew
        made = _compact(_prepare(piece, config, count))
    else:
        count(len(piece))
        return kept
    tensors = {name: getattr(made.images, name) for name in _SWEEP} | {name: getattr(made, name) for name in _MOTIONS}
    write_tensor_file(path, _KIND, tensors, {"name": piece.name, **key})
    return made


def _prepare(piece: Stretch, config: TrainingConfig, count: Counter) -> PreparedRecording:
    teacher = MapTeacher() if config.teacher == "map" and not piece.is_simulated else None

    def scans() -> Iterator[Scan]:
        for scan in in_order(piece.open().scans(piece.first, piece.stop)):
            if teacher is not None:
                teacher.follow(scan)
            yield scan
            count(1)

    try:
        made = prepare(scans(), config.images)
        return made if teacher is None else teacher.taught(made)
    except ValueError as error:
        raise InputError(f"{piece.name}: scans {piece.first} to {piece.stop} cannot be trained on: {error}") from error


def _compact(made: PreparedRecording) -> PreparedRecording:
    """Normals and offsets in half the memory; neither is known better than that."""
    images = made.images
    return replace(made, images=replace(images, normals=images.normals.half(), offsets=images.offsets.half()))


def _read(path: Path) -> PreparedRecording:
    tensors = read_tensor_file(path, _KIND).tensors
    if set(tensors) != {*_SWEEP, *_MOTIONS}:
        raise InputError(f"{path}: is incomplete")
    images = RecordedImages(*(tensors[name] for name in _SWEEP))
    return PreparedRecording(images, *(tensors[name] for name in _MOTIONS))


def _fingerprint(source: Path) -> list[int]:
    """How many files, their bytes, and when the last of them was changed, nanoseconds."""
    entries = source.rglob("*") if source.is_dir() else [source]
    stats = [entry.stat() for entry in entries if entry.is_file()]
    return [len(stats), sum(stat.st_size for stat in stats), max((stat.st_mtime_ns for stat in stats), default=0)]


def digest(stretches: Sequence[Stretch]) -> str:
    """A short text that tells these recordings from any others."""
    return _digest([[stretch.identity, stretch.first, stretch.stop] for stretch in stretches])


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]


def believed_share(recordings: Sequence[PreparedRecording]) -> float:
    """Of all pairs of consecutive scans, how many lie well on one another."""
    believed = torch.cat([recording.believed for recording in recordings])
    return float(believed.float().mean())
