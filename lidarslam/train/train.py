"""One training on disk and its steps: from the options of `lidarslam train` and recordings to weights."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Generator, nn

from lidarslam.config.settings import (
    SOURCES_SECTION,
    TrainConfig,
    dump_yaml,
    load_train_config,
    read_yaml,
    reader_settings,
)
from lidarslam.core.errors import ConfigError
from lidarslam.core.files import make_directory, only_writer, remove_partial_files, require_no_link
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.odometry.config import TrainingConfig
from lidarslam.odometry.network.checkpoint import (
    Checkpoint,
    checkpoint_of,
    load_checkpoint,
    network_of,
    save_checkpoint,
)
from lidarslam.odometry.network.networks import PairNetwork, make_network
from lidarslam.odometry.registry import default_weights
from lidarslam.odometry.training.losses import Validation, learning_rate, make_optimizer, objective, validate
from lidarslam.odometry.training.pairs import PairBatch, Pairs
from lidarslam.odometry.training.preparation import PreparedRecording
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.interruption import handling
from lidarslam.storage.directory import RunDirectory
from lidarslam.train import data
from lidarslam.train import directory as files

DeviceName = Literal["auto", "cpu", "cuda"]
# The settings that `--losses` stands for.
_LOSSES = {
    "both": ("training.geometric={}", "training.alignment_weight=0"),
    "point-to-plane": ("training.geometric={plane_to_plane: false}", "training.alignment_weight=0"),
    "plane-to-plane": ("training.geometric={point_to_plane: false}", "training.alignment_weight=0"),
    "paper": ("training.geometric={robust: false}", "training.alignment_weight=0"),
    "alignment": ("training.geometric=null", "training.alignment_weight=1"),
}


# Steps between lines of the log, and between validations.
LOG_EVERY, VALIDATE_EVERY = 50, 500
# Validations of a training, at most.
_MOST_VALIDATIONS = 10
# Largest norm of the gradient; longer ones are clipped.
_MOST_GRADIENT = 1.0
# Rotation and translation errors that count the same when validations are compared: a degree and five centimetres.
_ROTATION_DEG, _TRANSLATION_M = 1.0, 0.05
# Keeps the points that the losses draw apart from the pairs, which are drawn by the seed as it is.
_LOSS_STREAM = 7_919


@dataclass(eq=False)
class TrainingLoop:
    """The steps of one training."""

    config: TrainingConfig
    # network, optimizer: on the device
    network: nn.Module
    optimizer: torch.optim.Optimizer
    progress: files.Progress
    device: torch.device
    out: Path  # the directory of the training
    about: dict[str, Any]  # the data that the weights are trained on
    say: Callable[[str], None]  # prints a line

    def run(self, recordings: data.Recordings, is_interrupted: Callable[[], bool]) -> bool:
        """Do the remaining steps; whether all of them were done; ConfigError where the loss is no longer a number."""
        config, progress = self.config, self.progress
        is_new = not progress.step and progress.best is None  # or killed before its first state
        self._log = files.TrainingLog(self.out, None if is_new else progress.step)
        surfaces, birds = config.geometric is not None, config.network.name == "correlation"
        pairs = Pairs(recordings.learned, config.seed, surfaces, birds, recordings.weights, device=self.device)
        self._clock = time.perf_counter()
        if progress.best is None:
            self._validate(recordings.held_out)
        todo = range(progress.step, config.steps)
        validate_every = max(VALIDATE_EVERY, -(-config.steps // _MOST_VALIDATIONS))
        drawn = prefetch(pairs.batch(step, config.batch) for step in todo)
        with contextlib.closing(cast(Any, drawn)) as batches:
            for step, batch in zip(todo, batches, strict=True):
                if is_interrupted():
                    break
                self._step(step, batch)
                is_last = progress.step == config.steps
                if is_last or not progress.step % LOG_EVERY:
                    self._report()
                if is_last or not progress.step % validate_every:
                    self._validate(recordings.held_out)
                    self._save()
        if progress.step != config.steps:
            self._save_weights(files.LAST_WEIGHTS, None)
            if not recordings.held_out:
                self._save_weights(files.WEIGHTS, None)
        self._save()
        self._log.close()
        return progress.step == config.steps

    def _step(self, step: int, batch: PairBatch) -> None:
        config, progress = self.config, self.progress
        generator = Generator().manual_seed((config.seed * _LOSS_STREAM + step) * _LOSS_STREAM)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(step, config)
        self.optimizer.zero_grad()
        losses = objective(cast(PairNetwork, self.network)(batch), batch, config, generator)._asdict()
        losses["total"].backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), _MOST_GRADIENT)
        self.optimizer.step()
        values = torch.stack(list(losses.values())).tolist()  # one transfer from the device
        if not all(map(math.isfinite, values)):
            raise ConfigError(
                f"the loss is no longer a number at step {progress.step + 1}; lower training.learning_rate."
                f" The last state in {self.out} is from before"
            )
        for name, value in zip(losses, values, strict=True):
            progress.sums[name] = progress.sums.get(name, 0.0) + value
        progress.counted += 1
        progress.step += 1

    def _report(self) -> None:
        config, progress = self.config, self.progress
        losses = {name: value / progress.counted for name, value in progress.sums.items()}
        now = time.perf_counter()
        per_step = (now - self._clock) / progress.counted
        speed = config.batch / per_step
        self._clock, progress.sums, progress.counted = now, {}, 0
        rate = {"learning_rate": learning_rate(progress.step - 1, config), "pairs_per_s": speed}
        self._log.losses(progress.step, losses | rate)
        left_s = per_step * (config.steps - progress.step)
        self.say(files.format_step(progress.step, config.steps, losses, speed, left_s))

    def _validate(self, held_out: Sequence[PreparedRecording]) -> None:
        """Measure the network on the held-out recordings, and keep the best."""
        began, progress = time.perf_counter(), self.progress
        self.network.eval()
        self._save_weights(files.LAST_WEIGHTS, None)
        if held_out:
            result = validate(self.network, held_out, self.device)
            self._log.validation(progress.step, result)
            # Without anything to compare with, the last is as good as any.
            improves = progress.best is not None and score(result) < progress.best
            if improves or not result.pairs or progress.best is None:
                progress.best = score(result) if result.pairs else None
                self._save_weights(files.WEIGHTS, result if result.pairs else None)
            self.say(files.format_validation(progress.step, result, improves))
        else:
            self._save_weights(files.WEIGHTS, None)
        self.network.train()
        self._clock += time.perf_counter() - began

    def _save_weights(self, name: str, result: Validation | None) -> None:
        about = {**self.about, "steps": self.progress.step, "validation": result and vars(result)}
        checkpoint = checkpoint_of(self.network, self.config.network, self.config.images, about)
        save_checkpoint(self.out / name, checkpoint)

    def _save(self) -> None:
        files.save_state(self.out / files.STATE, self.network, self.optimizer, self.progress)


def score(result: Validation) -> float:
    """One number for a validation, lower is better; infinite without any pair.

    A few outliers decide the RMS, and the median does not see them: their geometric mean is taken.
    """
    rotation_deg = math.sqrt(result.rotation_rms_deg * result.rotation_median_deg)
    translation_m = math.sqrt(result.translation_rms_m * result.translation_median_m)
    value = rotation_deg / _ROTATION_DEG + translation_m / _TRANSLATION_M
    return value if math.isfinite(value) else math.inf


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
    has_state = request.resume and (request.out / files.STATE).exists()
    start = None if request.start_from is None or has_state else load_checkpoint(request.start_from)
    config = with_network_of(start, request.config)
    stretches = [
        *(data.recorded(source, config.reader) for source in request.sources),
        *data.simulated(config.simulated),
    ]
    if not stretches:
        raise ConfigError("there is nothing to train on; name a SOURCE, or set simulated.recordings=100")
    about = {
        "version": version("lidarslam"),
        "sources": [str(source) for source in request.sources],
        "recordings": len(stretches),
        "digest": data.digest(stretches),
    }
    if request.start_from is not None:
        about["from"] = str(request.start_from)
    device = _device(request.device)
    make_directory(request.out)
    with _interruption() as is_interrupted, only_writer(request.out):
        cache = request.prepared or request.out / files.PREPARED
        if request.prepared is None:
            require_no_link([cache])
        recordings = data.prepare_all(stretches, config.training, cache, request.where)
        remove_partial_files(request.out)  # of a training that was killed
        files.remove_results(request.out, [] if request.resume else earlier)
        RunDirectory(request.out).write_text(files.CONFIG, dump_yaml(config, about, SOURCES_SECTION))
        say(_summary(recordings, stretches, device))
        loop = _loop(request, config.training, start, device, about, say)
        if loop.progress.step:
            say(f"going on after step {loop.progress.step:,}")
        is_complete = loop.run(recordings, is_interrupted)
    written = load_checkpoint(request.out / files.WEIGHTS).about
    kept = written.get("validation")
    best = kept and Validation(**{**kept, "covered_percent": tuple(kept["covered_percent"])})
    say(files.format_outcome(request.out, loop.progress.step, written["steps"], best, not is_complete))
    return is_complete


def _device(name: DeviceName) -> torch.device:
    """The device that is asked for; ConfigError where it is not available."""
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise ConfigError("--device cuda: PyTorch finds no such device here; leave it out, or choose cpu")
    return torch.device("cuda", 0) if name != "cpu" and has_cuda else torch.device("cpu")


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


def _loop(
    request: TrainRequest, config: TrainingConfig, start: Checkpoint | None, device: torch.device,
    about: dict[str, Any], say: Callable[[str], None],
) -> TrainingLoop:  # fmt: skip
    """The training, at its beginning or where it was stopped."""
    if start is None:  # random weights, which follow from the seed alone
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            network = make_network(config.network)
    else:
        network = network_of(start).train()
    network = network.to(device)
    optimizer = make_optimizer(network, config)
    progress = files.Progress(data=about["digest"])
    state = request.out / files.STATE
    if request.resume and state.exists():
        progress = files.load_state(state, network, optimizer)
        if progress.data != about["digest"]:
            raise ConfigError(
                f"{request.out}: the recordings are not those that this training was begun with, or have changed;"
                f" to train the network on these, begin another with --from {request.out / files.LAST_WEIGHTS}"
            )
    # Weights are passed on: with the names of their recordings, not the folders.
    about = {**about, "sources": [source.name for source in request.sources]}
    if request.start_from is not None:
        about["from"] = request.start_from.name
    return TrainingLoop(config, network, optimizer, progress, device, request.out, about, say)


def _summary(recordings: data.Recordings, stretches: Sequence[data.Stretch], device: torch.device) -> str:
    drawn = sum(stretch.is_simulated for stretch in stretches)
    of_them = f", {drawn:,} of them simulated" if drawn else ""
    held = sum(len(recording) for recording in recordings.held_out)
    held_out = f"{held:,} more are held out for validation" if held else "none is held out for validation"
    scans = sum(len(recording) for recording in recordings.learned)
    valid = torch.cat([recording.valid for recording in recordings.learned])
    return (
        f"training on {len(stretches):,} recording{'s' if len(stretches) > 1 else ''}{of_them}: {scans:,} scans to"
        f" learn from, {held_out}; {100.0 * float(valid.float().mean()):.0f} % of consecutive scans could be"
        f" aligned. Computing on {device}"
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
    if earlier is not None and isinstance(section, dict):
        start_from = section.get("from")  # also where it was killed before its first state
    if start_from is not None:
        start_from = default_weights() if start_from == "shipped" else Path(start_from)
    named = {"training.steps": options["steps"], "training.network.name": options["network"]}
    settings = [
        *(() if options["losses"] is None else _LOSSES[options["losses"]]),
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
