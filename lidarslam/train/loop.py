"""The steps of a training on its devices: draw pairs, lower the loss, and at intervals log, validate and save."""

import contextlib
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Generator, Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from lidarslam.core.errors import ConfigError
from lidarslam.odometry.network.checkpoint import checkpoint_of, save_checkpoint
from lidarslam.odometry.network.networks import PairNetwork
from lidarslam.odometry.training.config import TrainingConfig
from lidarslam.odometry.training.losses import objective
from lidarslam.odometry.training.pairs import PairBatch, Pairs
from lidarslam.odometry.training.preparation import PreparedRecording
from lidarslam.odometry.training.training import Validation, learning_rate, validate
from lidarslam.pipeline.threads import prefetch
from lidarslam.train import directory as files
from lidarslam.train.directory import Progress, save_state
from lidarslam.train.log import TrainingLog, format_step, format_validation

DeviceName = Literal["auto", "cpu", "cuda"]


class Devices:
    """The `device` of this `process`, one of several `processes`, of which only the first, 0, writes and prints.

    ConfigError where the device is not available.
    """

    def __init__(self, name: DeviceName) -> None:
        if name == "cuda" and not torch.cuda.is_available():
            raise ConfigError("--device cuda: PyTorch finds no such device here; leave it out, or choose cpu")
        is_cuda = name != "cpu" and torch.cuda.is_available()
        self.device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if is_cuda else torch.device("cpu")
        self.processes = int(os.environ.get("WORLD_SIZE", "1"))
        self.process = int(os.environ.get("RANK", "0")) if self.processes > 1 else 0
        self.is_first = self.process == 0
        if is_cuda:
            torch.cuda.set_device(self.device)
        if self.processes > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if is_cuda else "gloo")

    def shared(self, module: nn.Module) -> nn.Module:
        """A module on the device, with gradients averaged over the processes."""
        if self.processes == 1:
            return module
        # Which parameters have a gradient depends on the losses.
        return DistributedDataParallel(module, find_unused_parameters=True)

    def wait(self) -> None:
        """Wait for all processes."""
        if self.processes > 1:
            distributed.barrier()

    def any(self, flag: bool) -> bool:
        """Whether it is true in any process."""
        if self.processes == 1:
            return flag
        total = torch.tensor(float(flag), device=self.device)
        distributed.all_reduce(total)
        return bool(total > 0.0)

    def close(self) -> None:
        """Leave the other processes."""
        if self.processes > 1 and distributed.is_initialized():
            distributed.destroy_process_group()


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


@dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings to train on, how often each is drawn, and recordings to validate on."""

    learned: Sequence[PreparedRecording]
    held_out: Sequence[PreparedRecording]
    weights: Sequence[float]


class _LossModule(nn.Module):
    """From a batch to its loss as one module, the unit that several processes can share."""

    def __init__(self, network: nn.Module, config: TrainingConfig) -> None:
        super().__init__()
        self.network, self.config = network, config

    def forward(self, batch: PairBatch, generator: Generator) -> dict[str, Tensor]:
        """The loss and its parts."""
        return objective(cast(PairNetwork, self.network)(batch), batch, self.config, generator)._asdict()


@dataclass(eq=False)
class TrainingLoop:
    """One training in one process; only the first process validates, writes and prints."""

    config: TrainingConfig
    # network, optimizer: on the device
    network: nn.Module
    optimizer: torch.optim.Optimizer
    progress: Progress
    devices: Devices
    out: Path  # the directory of the training
    about: dict[str, Any]  # the data that the weights are trained on
    say: Callable[[str], None]  # prints a line

    def run(self, recordings: Recordings, is_interrupted: Callable[[], bool]) -> bool:
        """Do the remaining steps; whether all of them were done; ConfigError where the loss is no longer a number."""
        config, progress, devices = self.config, self.progress, self.devices
        self._module = devices.shared(_LossModule(self.network, config))
        is_new = not progress.step and progress.best is None  # or killed before its first state
        self._log = TrainingLog(self.out, None if is_new else progress.step) if devices.is_first else None
        surfaces, birds = config.geometric is not None, config.network.name == "correlation"
        pairs = Pairs(recordings.learned, config.seed, surfaces, birds, recordings.weights, device=devices.device)
        self._clock = time.perf_counter()
        if progress.best is None:
            self._validate(recordings)
        todo = range(progress.step, config.steps)
        validate_every = max(VALIDATE_EVERY, -(-config.steps // _MOST_VALIDATIONS))
        drawn = prefetch(pairs.batch(step, config.batch, devices.process) for step in todo)
        with contextlib.closing(cast(Any, drawn)) as batches:
            for step, batch in zip(todo, batches, strict=True):
                if devices.any(is_interrupted()):
                    break
                self._step(step, batch)
                is_last = progress.step == config.steps
                if is_last or not progress.step % LOG_EVERY:
                    self._report()
                if is_last or not progress.step % validate_every:
                    self._validate(recordings)
                    self._save()
        self._save()
        if self._log is not None:
            self._log.close()
        return progress.step == config.steps

    def _step(self, step: int, batch: PairBatch) -> None:
        config, progress = self.config, self.progress
        generator = Generator().manual_seed((config.seed * _LOSS_STREAM + step) * _LOSS_STREAM + self.devices.process)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(step, config)
        self.optimizer.zero_grad()
        losses: dict[str, Tensor] = self._module(batch, generator)
        losses["total"].backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._module.parameters(), _MOST_GRADIENT)
        self.optimizer.step()
        values = torch.stack(list(losses.values())).tolist()  # one transfer from the device
        for name, value in zip(losses, values, strict=True):
            progress.sums[name] = progress.sums.get(name, 0.0) + value
        progress.counted += 1
        progress.step += 1

    def _report(self) -> None:
        config, progress = self.config, self.progress
        losses = {name: value / progress.counted for name, value in progress.sums.items()}
        if not math.isfinite(losses["total"]):
            raise ConfigError(
                f"the loss is no longer a number at step {progress.step}; lower training.learning_rate."
                f" The last state in {self.out} is from before"
            )
        now = time.perf_counter()
        per_step = (now - self._clock) / progress.counted
        speed = config.batch * self.devices.processes / per_step
        self._clock, progress.sums, progress.counted = now, {}, 0
        if self._log is not None:
            rate = {"learning_rate": learning_rate(progress.step - 1, config), "pairs_per_s": speed}
            self._log.losses(progress.step, losses | rate)
            left_s = per_step * (config.steps - progress.step)
            self.say(format_step(progress.step, config.steps, losses, speed, left_s))

    def _validate(self, recordings: Recordings) -> None:
        """Measure the network on the held-out recordings, and keep the best."""
        began = time.perf_counter()
        if self._log is not None:
            self.network.eval()
            progress = self.progress
            self._save_weights(files.LAST_WEIGHTS, None)
            if recordings.held_out:
                result = validate(self.network, recordings.held_out, self.devices.device)
                self._log.validation(progress.step, result)
                # Without anything to compare with, the last is as good as any.
                improves = progress.best is not None and score(result) < progress.best
                if improves or not result.pairs or progress.best is None:
                    progress.best = score(result) if result.pairs else None
                    self._save_weights(files.WEIGHTS, result if result.pairs else None)
                self.say(format_validation(progress.step, result, improves))
            else:
                self._save_weights(files.WEIGHTS, None)
            self.network.train()
        self.devices.wait()
        self._clock += time.perf_counter() - began

    def _save_weights(self, name: str, result: Validation | None) -> None:
        about = {**self.about, "steps": self.progress.step, "validation": result and vars(result)}
        checkpoint = checkpoint_of(self.network, self.config.network, self.config.images, about)
        save_checkpoint(self.out / name, checkpoint)

    def _save(self) -> None:
        if self._log is not None:
            save_state(self.out / files.STATE, self.network, self.optimizer, self.progress)


def score(result: Validation) -> float:
    """One number for a validation, lower is better; infinite without any pair.

    A few outliers decide the RMS, and the median does not see them: their geometric mean is taken.
    """
    rotation_deg = math.sqrt(result.rotation_rms_deg * result.rotation_median_deg)
    translation_m = math.sqrt(result.translation_rms_m * result.translation_median_m)
    value = rotation_deg / _ROTATION_DEG + translation_m / _TRANSLATION_M
    return value if math.isfinite(value) else math.inf
