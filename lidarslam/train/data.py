"""The data of a training: recordings and simulations, prepared once, in parallel if asked for, and kept on disk."""

import hashlib
import json
import random
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.scan import Scan, ScanSequence
from lidarslam.core.spin_axis import image_axes
from lidarslam.core.tasks import Where, open_tasks
from lidarslam.core.tracking import Status
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.config import SimulatedConfig, TrainingConfig
from lidarslam.odometry.network.checkpoint import Kind, read_tensor_file, write_tensor_file
from lidarslam.odometry.training.preparation import PreparedRecording, prepare
from lidarslam.pipeline.threads import in_order
from lidarslam.run.interruption import handling
from lidarslam.run.progress import show_count
from lidarslam.simulation.mixture import MIXED_WORLDS, SENSOR_WEIGHTS, ingredients_of, mixture


class MapTeacher:
    """Registers a recording at constant velocity, scan after scan, in the axes of its images."""

    def __init__(self) -> None:
        self._mapper = Mapper(MappingConfig())
        self._R_image_lidar: FloatArray | None = None
        self._T_world_middle: list[FloatArray] = []
        self._is_ok: list[bool] = []

    def follow(self, scan: Scan) -> None:
        if self._R_image_lidar is None:
            self._R_image_lidar = image_axes(scan.points)
        scan = replace(scan, points=scan.points @ self._R_image_lidar.T)
        mapped = self._mapper.process(self._mapper.sample(scan), Prior())
        state = mapped.state
        self._T_world_middle.append(state.T_world_lidar @ exp(state.velocity * scan.middle_offset_s))
        # When the first scan is registered its velocity is not known, and so neither is the middle of its sweep.
        self._is_ok.append(mapped.status is Status.OK and len(self._T_world_middle) > 1)

    def relabelled(self, recording: PreparedRecording) -> PreparedRecording:
        """The recording of these scans with the motions between the middles of sweeps on the map.

        A motion is valid where both poses have the status ok.
        """
        T = np.stack(self._T_world_middle)
        T_prev_curr = inverse(T[:-1]) @ T[1:]
        is_ok = torch.tensor(self._is_ok)
        return replace(recording, T_prev_curr=torch.from_numpy(T_prev_curr).float(), valid=is_ok[:-1] & is_ok[1:])


# Scans that are held in memory as full images at a time; a longer recording becomes several.
PIECE = 500
# Share of the pairs that are from recordings where there are simulated ones too.
RECORDED_SHARE = 0.3
# Draws the simulated recordings.
_SIMULATION_SEED = 0
# To be raised whenever preparation, or the simulation, gives other results than before.
_KIND = Kind("a recording prepared for training", version=5)

Counter = Callable[[int], None]
"""Called with the number of scans that were prepared since the last call."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive scans of a recording that is opened when it is needed."""

    name: str  # of the recording
    # differs from that of any other recording, and of the same before a change; values that JSON can hold
    identity: dict[str, Any]
    open: Callable[[], ScanSequence]  # gives its scans; can be pickled
    # first, stop: which of them, as in `range`
    first: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def is_simulated(self) -> bool:
        return "simulated" in self.identity

    def pieces(self) -> Iterator["Stretch"]:
        """The same scans in parts of about equal length, none longer than `PIECE`."""
        count = -(-len(self) // PIECE)
        borders = [self.first + number * len(self) // count for number in range(count + 1)]
        for first, stop in pairwise(borders):
            yield replace(self, first=first, stop=stop)


def recorded(source: Path, reader: ReaderConfig) -> Stretch:
    """All of a recording; InputError where it cannot be read, or has fewer than two scans."""
    recording = open_recording(source, reader)
    if len(recording) < 2:
        raise InputError(f"{source}: training needs pairs of scans, this recording has {len(recording)}")
    stats = [entry.stat() for entry in (source.rglob("*") if source.is_dir() else [source]) if entry.is_file()]
    newest_ns = max((stat.st_mtime_ns for stat in stats), default=0)
    identity = {
        "source": str(source.resolve()),
        "files": [len(stats), sum(stat.st_size for stat in stats), newest_ns],
        "reader": reader.model_dump(mode="json"),
    }
    return Stretch(recording.name, identity, partial(open_recording, source, reader), 0, len(recording))


def simulated(config: SimulatedConfig) -> list[Stretch]:
    """The simulated recordings; their worlds are built when they are needed.

    ConfigError where a world or sensor is not in the mixture, or no recording is of that kind.
    """
    for key, names, known in (("worlds", config.worlds, MIXED_WORLDS), ("sensors", config.sensors, SENSOR_WEIGHTS)):
        for name in names or ():
            if name not in known:
                raise ConfigError(f"simulated.{key}: there is no {name!r}; choose from {', '.join(known)}")
    kinds = [ingredients_of(number, _SIMULATION_SEED) for number in range(config.recordings)]
    chosen = [
        number
        for number, kind in enumerate(kinds)
        if kind.world in (config.worlds or MIXED_WORLDS) and kind.sensor in (config.sensors or SENSOR_WEIGHTS)
    ]
    if config.recordings and not chosen:
        raise ConfigError(
            f"simulated.recordings={config.recordings}: none is of the worlds and sensors asked for; ask for more"
        )
    about = {"seed": _SIMULATION_SEED, "scans": config.scans}
    return [
        Stretch(f"simulation {n}", {"simulated": n, **about}, partial(_build, n, config.scans), 0, config.scans)
        for n in chosen
    ]


def _build(number: int, scans: int) -> ScanSequence:
    return next(mixture(1, scans, _SIMULATION_SEED, number))


def hold_out(stretches: Sequence[Stretch], share: float, seed: int) -> tuple[list[Stretch], list[Stretch]]:
    """Those to train on, and those kept for validation: whole recordings, or the end of the only one.

    InputError where the only recording is too short to be divided.
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


def draw_weights(stretches: Sequence[Stretch]) -> list[float]:
    """How often each prepared recording is drawn, relative to the others, in the order of `prepared`.

    Where there are simulated recordings too, the others have `RECORDED_SHARE` together, by their numbers of scans.
    """
    pieces = [piece for stretch in stretches for piece in stretch.pieces()]
    recorded_scans = sum(len(piece) for piece in pieces if not piece.is_simulated)
    simulated_count = sum(piece.is_simulated for piece in pieces)
    if not recorded_scans or not simulated_count:
        return [1.0] * len(pieces)
    return [
        (1.0 - RECORDED_SHARE) / simulated_count if piece.is_simulated else RECORDED_SHARE * len(piece) / recorded_scans
        for piece in pieces
    ]


def prepared(
    stretches: Sequence[Stretch], config: TrainingConfig, cache: Path, count: Counter
) -> list[PreparedRecording]:
    """The stretches prepared for training, from the cache where they are in it already.

    InputError where a recording is unreadable, OutputError where the cache cannot be written.
    """
    return [prepared_piece(piece, config, cache, count) for stretch in stretches for piece in stretch.pieces()]


def prepared_piece(piece: Stretch, config: TrainingConfig, cache: Path, count: Counter) -> PreparedRecording:
    """One of the pieces of a stretch, as `prepared`."""
    path = file_of(piece, config, cache)
    try:
        kept = PreparedRecording(**read_tensor_file(path, _KIND)[0])
        kept.require(len(piece), config.images)
    except (InputError, TypeError, ValueError):  # not there yet, or damaged: made again
        made = _prepare(piece, config, count)
        write_tensor_file(path, _KIND, vars(made), {"name": piece.name, **_key(piece, config)})
        return made
    count(len(piece))
    return kept


def _key(piece: Stretch, config: TrainingConfig) -> dict[str, Any]:
    images = config.images.model_dump(mode="json")
    key = {**piece.identity, "first": piece.first, "stop": piece.stop, "images": images, "version": _KIND.version}
    return key if piece.is_simulated else {**key, "teacher": config.teacher}


def file_of(piece: Stretch, config: TrainingConfig, cache: Path) -> Path:
    """Where a piece is kept once it is prepared."""
    return cache / f"{_digest(_key(piece, config))}.safetensors"


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
    except ValueError as error:
        raise InputError(f"{piece.name}: scans {piece.first} to {piece.stop} cannot be trained on: {error}") from error
    # Half precision is enough for normals and offsets.
    made = replace(made, normals=made.normals.half(), offsets=made.offsets.half())
    return made if teacher is None else teacher.relabelled(made)


def digest(stretches: Sequence[Stretch]) -> str:
    """A short text that differs for any other recordings."""
    return _digest([[stretch.identity, stretch.first, stretch.stop] for stretch in stretches])


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]


@dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings to train on, how often each is drawn, and recordings to validate on."""

    learned: Sequence[PreparedRecording]
    held_out: Sequence[PreparedRecording]
    weights: Sequence[float]


def prepare_all(stretches: Sequence[Stretch], config: TrainingConfig, cache: Path, where: Where) -> Recordings:
    """All recordings, prepared into the cache where they are not in it already, and divided.

    InputError where a recording is unreadable, OutputError where the cache cannot be written, or is another folder on
    the nodes of a cluster. After Ctrl-C, finished recordings stay in the cache.
    """
    learned, held_out = hold_out(stretches, config.hold_out, config.seed)
    with handling(signal.default_int_handler):  # a training's own first Ctrl-C only notes the request
        if not where.is_serial:
            _prepare_side_by_side([*learned, *held_out], config, cache, where)
        with _counting("preparing recordings", stretches) as count:
            return Recordings(
                learned=prepared(learned, config, cache, count),
                held_out=prepared(held_out, config, cache, count),
                weights=draw_weights(learned),
            )


def _prepare_side_by_side(stretches: Sequence[Stretch], config: TrainingConfig, cache: Path, where: Where) -> None:
    pieces = [piece for stretch in stretches for piece in stretch.pieces()]
    wanted = [piece for piece in pieces if not file_of(piece, config, cache).is_file()]
    prepare_one = partial(_prepare_one, config=config, cache=cache.absolute())
    with _counting("preparing side by side", wanted) as count, open_tasks(where) as tasks:
        deque(tasks.run(prepare_one, wanted, lambda index, _: count(len(wanted[index]))), maxlen=0)
    if not all(file_of(piece, config, cache).is_file() for piece in wanted):
        raise OutputError(f"{cache}: is not shared by the nodes of the cluster; name a folder that is with --prepared")


@contextmanager
def _counting(words: str, stretches: Sequence[Stretch]) -> Iterator[Counter]:
    """A bar of the scans that are prepared."""
    done, total = 0, sum(map(len, stretches))
    with show_count(words) as show:

        def count(more: int) -> None:
            nonlocal done
            done += more
            show(done, total)

        yield count


def _prepare_one(piece: Stretch, config: TrainingConfig, cache: Path) -> None:
    prepared_piece(piece, config, cache, lambda _: None)
