"""One training on disk: from recordings to weights."""

import contextlib
import signal
import threading
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any

import torch
from torch import nn

from lidarslam.core.errors import ConfigError
from lidarslam.core.files import make_directory, only_writer
from lidarslam.run.directory import RunDirectory
from lidarslam.train import directory as files
from lidarslam.train.config import TrainConfig, dump_train_yaml
from lidarslam.train.data import (
    Counter,
    Stretch,
    believed_share,
    digest,
    draw_weights,
    hold_out,
    prepared,
    recorded,
    simulated,
)
from lidarslam.train.devices import Devices
from lidarslam.train.loop import Recordings, TrainingLoop
from lidarslam.train.request import Interrupted, Material, TrainNarrator, TrainOutcome, TrainRequest
from lidarslam.train.state import Standing, load_state
from odometry.network.checkpoint import Checkpoint, load_checkpoint, network_of
from odometry.network.networks import make_network
from odometry.training.training import Validation, make_optimizer
from odometry.training.training_config import TrainingConfig


def execute(request: TrainRequest, narrator: TrainNarrator) -> TrainOutcome:
    """Train, and write the directory.

    Ctrl-C ends the training after the step at work, and it can be gone on with.

    Raises:
        LidarSlamError: sources, configuration, weights or output directory are not usable.
    """
    earlier = files.earlier_training(request.out, request.resume, request.overwrite)
    start = None if request.start_from is None else load_checkpoint(request.start_from)
    config = with_network_of(start, request.config)
    stretches = [*(recorded(source, config.reader) for source in request.sources), *simulated(config.simulated)]
    if not stretches:
        raise ConfigError("there is nothing to train on; name a SOURCE, or set simulated.recordings=100")
    devices = Devices(request.device, config.training.precision)
    make_directory(request.out)
    about = _about(request, stretches)
    alone = only_writer(request.out) if devices.is_first else contextlib.nullcontext()
    with alone, _interruption() as interrupted:
        recordings = _recordings(request, config.training, stretches, devices, _Count(stretches, narrator, interrupted))
        if devices.is_first:
            files.remove_results(request.out, [] if request.resume else earlier)
            RunDirectory(request.out).write_text(files.CONFIG, dump_train_yaml(config, about))
            narrator.material(_material(recordings, stretches, devices))
        standing, loop = _loop(request, config.training, start, devices, about)
        if standing.step and devices.is_first:
            narrator.going_on(standing.step)
        is_complete = loop.run(recordings, narrator, interrupted)
    return TrainOutcome(standing.step, not is_complete, request.out / files.WEIGHTS, _best(request), devices.is_first)


def with_network_of(start: Checkpoint | None, config: TrainConfig) -> TrainConfig:
    """The configuration with network and images of the weights that are begun with.

    Raises:
        ConfigError: it asks for others itself.
    """
    if start is None:
        return config
    default = TrainingConfig()
    for name in ("network", "images"):
        asked, given = getattr(config.training, name), getattr(start, name)
        if asked not in (getattr(default, name), given):
            raise ConfigError(f"training.{name} is not that of the weights to begin with; leave it, or --from, out")
    training = config.training.model_copy(update={"network": start.network, "images": start.images})
    return config.model_copy(update={"training": training})


class _Count:
    """Counts the scans that are ready; an interruption ends the preparation, and what is ready is kept."""

    def __init__(self, stretches: Sequence[Stretch], narrator: TrainNarrator, interrupted: Interrupted) -> None:
        self._done, self._total = 0, sum(len(stretch) for stretch in stretches)
        self._narrator, self._interrupted = narrator, interrupted

    def __call__(self, more: int) -> None:
        if self._interrupted():
            raise KeyboardInterrupt
        self._done += more
        self._narrator.preparing(self._done, self._total)


def _recordings(
    request: TrainRequest, config: TrainingConfig, stretches: Sequence[Stretch], devices: Devices, count: Counter
) -> Recordings:
    """All recordings, ready; the first process makes them, and the others find them in the cache."""
    cache = request.prepared or request.out / files.PREPARED
    learned, held_out = hold_out(stretches, config.hold_out, config.seed)
    if not devices.is_first:
        devices.wait()
    recordings = Recordings(
        learned=prepared(learned, config, cache, count),
        held_out=prepared(held_out, config, cache, count),
        weights=draw_weights(learned, config.recorded_share),
    )
    if devices.is_first:
        devices.wait()
    return recordings


def _loop(
    request: TrainRequest, config: TrainingConfig, start: Checkpoint | None, devices: Devices, about: dict[str, Any]
) -> tuple[Standing, TrainingLoop]:
    """The training, at its beginning or where it was left."""
    network = _first_network(config, start)
    optimizer = make_optimizer(network, config)
    standing = Standing(data=about["digest"])
    state = request.out / files.STATE
    if request.resume and state.exists():
        standing = load_state(state, network, optimizer)
        if standing.data != about["digest"]:
            raise ConfigError(
                f"{request.out}: the recordings are not those that this training was begun with, or have changed;"
                f" to train the network on these, begin another with --from {request.out / files.LAST_WEIGHTS}"
            )
    return standing, TrainingLoop(config, network, optimizer, standing, devices, request.out, about)


def _first_network(config: TrainingConfig, start: Checkpoint | None) -> nn.Module:
    """The network as the training begins with it: its random weights follow from the seed alone."""
    if start is not None:
        return network_of(start).train()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return make_network(config.network)


def _about(request: TrainRequest, stretches: Sequence[Stretch]) -> dict[str, Any]:
    about: dict[str, Any] = {
        "version": version("lidarslam"),
        "sources": [str(source) for source in request.sources],
        "recordings": len(stretches),
        "digest": digest(stretches),
    }
    return about if request.start_from is None else {**about, "from": str(request.start_from)}


def _material(recordings: Recordings, stretches: Sequence[Stretch], devices: Devices) -> Material:
    held_out = recordings.held_out
    return Material(
        recordings=len(stretches),
        simulated=sum(stretch.is_simulated for stretch in stretches),
        scans=sum(len(recording) for recording in recordings.learned),
        held_out_scans=sum(len(recording) for recording in held_out),
        believed_percent=100.0 * believed_share(recordings.learned),
        device=str(devices.device),
        processes=devices.processes,
    )


def _best(request: TrainRequest) -> Validation | None:
    """What the weights that are kept say of themselves."""
    values = load_checkpoint(request.out / files.WEIGHTS).about.get("validation")
    if values is None:
        return None
    first, second, third = values.pop("covered_percent")
    return Validation(**values, covered_percent=(first, second, third))


@contextlib.contextmanager
def _interruption() -> Iterator[Interrupted]:
    """For the time of a training, Ctrl-C and a request to end are noted; Ctrl-C once more ends it at once."""
    asked = threading.Event()

    def note(signum: int, frame: Any) -> None:  # noqa: ARG001
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    if threading.current_thread() is not threading.main_thread():  # signals go to the main thread
        yield asked.is_set
        return
    # A request that is ignored, as nohup asks, stays ignored.
    asking = (n for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is not signal.SIG_IGN)
    earlier = [(number, signal.signal(number, note)) for number in asking]
    try:
        yield asked.is_set
    finally:
        for number, handler in earlier:
            signal.signal(number, handler)
