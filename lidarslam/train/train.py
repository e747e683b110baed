"""One training on disk: from the options of `lidarslam train` and recordings to weights."""

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from lidarslam.config.settings import SOURCES_SECTION, reader_settings
from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError
from lidarslam.core.files import make_directory, only_writer, remove_partial_files, require_no_link
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.odometry.network.checkpoint import Checkpoint, load_checkpoint, network_of
from lidarslam.odometry.network.networks import make_network
from lidarslam.odometry.network.shipped import default_weights
from lidarslam.odometry.training.config import TrainingConfig
from lidarslam.odometry.training.training import Validation, make_optimizer
from lidarslam.run.interruption import handling
from lidarslam.run.progress import show_count
from lidarslam.storage.directory import RunDirectory
from lidarslam.train import directory as files
from lidarslam.train.data import (
    Stretch,
    digest,
    draw_weights,
    hold_out,
    prepare_side_by_side,
    prepared,
    recorded,
    simulated,
)
from lidarslam.train.directory import Progress, load_state
from lidarslam.train.log import format_outcome
from lidarslam.train.loop import DeviceName, Devices, Recordings, TrainingLoop
from lidarslam.train.settings import LOSSES, TrainConfig, dump_train_yaml, load_train_config


@dataclass(frozen=True)
class TrainRequest:
    """A training."""

    sources: tuple[Path, ...]  # recordings; may be none where the configuration names simulated ones
    out: Path  # the directory of the training
    config: TrainConfig
    start_from: Path | None = None  # weights to begin with instead of random ones
    device: DeviceName = "auto"
    prepared: Path | None = None  # where prepared recordings are kept; None: in `out`
    resume: bool = False  # continue the training in `out`
    overwrite: bool = False  # replace it
    where: Where = SERIAL  # whether recordings are prepared one after another or side by side


def execute(request: TrainRequest, say: Callable[[str], None]) -> bool:
    """Train and write the directory; whether all steps were done.

    Ctrl-C ends the training after the current step, and it can be resumed.

    LidarSlamError where sources, configuration, weights or output directory are not usable.
    """
    earlier = files.earlier_training(request.out, request.resume, request.overwrite)
    start = None if request.start_from is None else load_checkpoint(request.start_from)
    config = with_network_of(start, request.config)
    stretches = [*(recorded(source, config.reader) for source in request.sources), *simulated(config.simulated)]
    if not stretches:
        raise ConfigError("there is nothing to train on; name a SOURCE, or set simulated.recordings=100")
    about = {
        "version": version("lidarslam"),
        "sources": [str(source) for source in request.sources],
        "recordings": len(stretches),
        "digest": digest(stretches),
    }
    if request.start_from is not None:
        about["from"] = str(request.start_from)
    with contextlib.closing(Devices(request.device)) as devices, _interruption() as is_interrupted:
        make_directory(request.out)
        with only_writer(request.out) if devices.is_first else contextlib.nullcontext():
            recordings = _recordings(request, config.training, stretches, devices, is_interrupted)
            if devices.is_first:
                remove_partial_files(request.out)  # of a training that was killed
                files.remove_results(request.out, [] if request.resume else earlier)
                RunDirectory(request.out).write_text(files.CONFIG, dump_train_yaml(config, about))
                say(_summary(recordings, stretches, devices))
            loop, progress = _loop(request, config.training, start, devices, about, say)
            if progress.step and devices.is_first:
                say(f"going on after step {progress.step:,}")
            is_complete = loop.run(recordings, is_interrupted)
        if devices.is_first:
            weights = request.out / files.WEIGHTS
            kept = load_checkpoint(weights).about.get("validation")
            best = kept and Validation(**{**kept, "covered_percent": tuple(kept["covered_percent"])})
            say(format_outcome(request.out, weights, progress.step, best, not is_complete))
    return is_complete


def with_network_of(start: Checkpoint | None, config: TrainConfig) -> TrainConfig:
    """The configuration with network and images of the weights that are begun with.

    ConfigError where it asks for others itself.
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


def _recordings(
    request: TrainRequest, config: TrainingConfig, stretches: Sequence[Stretch], devices: Devices,
    is_interrupted: Callable[[], bool],
) -> Recordings:  # fmt: skip
    """All recordings, prepared; the first process does that, and the others find them in the cache."""
    cache = request.prepared or request.out / files.PREPARED
    if request.prepared is None:
        require_no_link([cache])
    learned, held_out = hold_out(stretches, config.hold_out, config.seed)
    done, total = 0, sum(len(stretch) for stretch in stretches)
    if not devices.is_first:
        devices.wait()
    if devices.is_first and not request.where.is_serial:
        prepare_side_by_side([*learned, *held_out], config, cache, request.where)
    with show_count("preparing recordings") as show:

        def count(more: int) -> None:
            """An interruption ends the preparation; prepared recordings stay in the cache."""
            nonlocal done
            if is_interrupted():
                raise KeyboardInterrupt
            done += more
            show(done, total)

        recordings = Recordings(
            learned=prepared(learned, config, cache, count),
            held_out=prepared(held_out, config, cache, count),
            weights=draw_weights(learned),
        )
    if devices.is_first:
        devices.wait()
    return recordings


def _loop(
    request: TrainRequest, config: TrainingConfig, start: Checkpoint | None, devices: Devices,
    about: dict[str, Any], say: Callable[[str], None],
) -> tuple[TrainingLoop, Progress]:  # fmt: skip
    """The training, at its beginning or where it was stopped."""
    if start is None:  # random weights, which follow from the seed alone
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            network = make_network(config.network)
    else:
        network = network_of(start).train()
    network = network.to(devices.device)
    optimizer = make_optimizer(network, config)
    progress = Progress(data=about["digest"])
    state = request.out / files.STATE
    if request.resume and state.exists():
        progress = load_state(state, network, optimizer)
        if progress.data != about["digest"]:
            raise ConfigError(
                f"{request.out}: the recordings are not those that this training was begun with, or have changed;"
                f" to train the network on these, begin another with --from {request.out / files.LAST_WEIGHTS}"
            )
    # Weights are passed on: with the names of their recordings, not the folders.
    about = {**about, "sources": [source.name for source in request.sources]}
    if request.start_from is not None:
        about["from"] = request.start_from.name
    return TrainingLoop(config, network, optimizer, progress, devices, request.out, about, say), progress


def _summary(recordings: Recordings, stretches: Sequence[Stretch], devices: Devices) -> str:
    drawn = sum(stretch.is_simulated for stretch in stretches)
    of_them = f", {drawn:,} of them simulated" if drawn else ""
    held = sum(len(recording) for recording in recordings.held_out)
    held_out = f"{held:,} more are held out for validation" if held else "none is held out for validation"
    scans = sum(len(recording) for recording in recordings.learned)
    valid = torch.cat([recording.valid for recording in recordings.learned])
    processes = f" in {devices.processes} processes" if devices.processes > 1 else ""
    return (
        f"training on {len(stretches):,} recording{'s' if len(stretches) > 1 else ''}{of_them}: {scans:,} scans to"
        f" learn from, {held_out}; {100.0 * float(valid.float().mean()):.0f} % of consecutive scans could be"
        f" aligned. Computing on {devices.device}{processes}"
    )


@contextlib.contextmanager
def _interruption() -> Iterator[Callable[[], bool]]:
    """During a training, Ctrl-C and a request to end are noted; Ctrl-C once more ends it at once."""
    asked = threading.Event()

    def note(signum: int, frame: Any) -> None:  # noqa: ARG001
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    with handling(note):
        yield asked.is_set


def run_train(sources: tuple[Path, ...], say: Callable[[str], None], **options: Any) -> bool:
    """Train with the options of `lidarslam train --help`; whether all steps were done.

    A resumed training keeps its settings, except those that are given again.

    LidarSlamError where options contradict each other, a value does not fit, or as `execute`.
    """
    out, start_from = options["out"], options["start_from"]
    if options["resume"] and options["overwrite"]:
        raise ConfigError("--resume goes on with what --overwrite replaces; choose one")
    if options["resume"] and start_from is not None:
        raise ConfigError("--resume goes on with the weights it left; leave --from out")
    earlier = out / files.CONFIG if options["resume"] and files.is_training(out) else None
    section = {} if earlier is None else read_yaml(earlier).get(SOURCES_SECTION)
    earlier_sources = section.get("sources", []) if isinstance(section, dict) else []
    if start_from is not None:
        start_from = default_weights() if start_from == "shipped" else Path(start_from)
    named = {"training.steps": options["steps"], "training.network.name": options["network"]}
    settings = [
        *(() if options["losses"] is None else LOSSES[options["losses"]]),
        *options["settings"],
        *(f"{key}={value}" for key, value in named.items() if value is not None),
        *reader_settings(name=options["reader"], topic=options["topic"], sequence=options["sequence"]),
    ]
    request = TrainRequest(
        sources=sources or tuple(Path(str(source)) for source in earlier_sources),
        out=out,
        config=load_train_config(options["config_file"] or earlier, settings),
        start_from=start_from,
        **{name: options[name] for name in ("device", "prepared", "resume", "overwrite", "where")},
    )
    return execute(request, say)
