"""The steps of a training: draw pairs, lower the loss, write it down, and now and then validate and save."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import Generator, Tensor, nn

from lidarslam.core.errors import ConfigError
from lidarslam.pipeline.scan_stream import prefetch
from lidarslam.train import directory as files
from lidarslam.train.devices import Devices
from lidarslam.train.log import TrainingLog
from lidarslam.train.request import Interrupted, StepReport, TrainNarrator
from lidarslam.train.state import Standing, save_state
from odometry.network.checkpoint import checkpoint_of, save_checkpoint
from odometry.network.networks import PairNetwork
from odometry.training.pairs import PairBatch, Pairs
from odometry.training.preparation import PreparedRecording
from odometry.training.training import Validation, learning_rate, loss_of, validate
from odometry.training.training_config import TrainingConfig

# Rotation and translation errors that count the same when validations are compared: a degree and five centimetres.
_ROTATION_DEG, _TRANSLATION_M = 1.0, 0.05
# Keeps the points that the losses draw apart from the pairs, which are drawn by the seed as it is.
_LOSS_STREAM = 7_919


@dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings to learn from, how often each is drawn, and recordings to validate on."""

    learned: Sequence[PreparedRecording]
    held_out: Sequence[PreparedRecording]
    weights: Sequence[float]


class _LossModule(nn.Module):
    """The whole way from a batch to its loss as one module, which is what several processes can share."""

    def __init__(self, network: nn.Module, config: TrainingConfig) -> None:
        super().__init__()
        self.network = network
        self.config = config

    def forward(self, batch: dict[str, Tensor | None], generator: Generator) -> dict[str, Tensor]:
        """The loss and its parts; plain dictionaries, which every precision can convert."""
        pairs = PairBatch(**cast(dict[str, Any], batch))
        return dict(vars(loss_of(cast(PairNetwork, self.network), pairs, self.config, generator)))


class TrainingLoop:
    """One training in one process; only the first process validates, writes and speaks."""

    def __init__(
        self,
        config: TrainingConfig,
        network: nn.Module,
        optimizer: torch.optim.Optimizer,
        standing: Standing,
        devices: Devices,
        out: Path,
        about: dict[str, Any],
    ) -> None:
        self._config, self._devices, self._out, self._about = config, devices, out, about
        self._network = network
        self._plain_optimizer = optimizer
        self._standing = standing
        devices.set_loss_scale(standing.loss_scale)
        self._module, self._optimizer = devices.set_up(_LossModule(network, config), optimizer)
        self._log = TrainingLog(out, standing.step) if devices.is_first else None
        self._clock = time.perf_counter()

    def run(self, recordings: Recordings, narrator: TrainNarrator, interrupted: Interrupted) -> bool:
        """Do the steps that are left; whether all of them were done.

        Raises:
            ConfigError: the loss is no longer a number.
        """
        config, standing = self._config, self._standing
        surfaces = config.geometric is not None and config.geometric_weight > 0.0
        birds = config.network.name == "correlation"
        pairs = Pairs(recordings.learned, config.augmentation, config.seed, surfaces, birds, recordings.weights)
        if standing.best is None:
            self._validate(recordings, narrator)
        self._clock = time.perf_counter()
        todo = range(standing.step, config.steps)
        batches = prefetch(pairs.batch(step, config.batch, self._devices.process) for step in todo)
        for step, batch in zip(todo, batches, strict=True):
            if self._devices.any(interrupted()):
                batches.close()  # type: ignore[attr-defined]  # ends the thread that draws
                break
            self._step(step, batch)
            is_last = standing.step == config.steps
            if is_last or not standing.step % config.log_every:
                self._report(narrator)
            if is_last or not standing.step % config.validate_every:
                self._validate(recordings, narrator)
                self._save()
        self._save()
        if self._log is not None:
            self._log.close()
        return standing.step == config.steps

    def _step(self, step: int, batch: PairBatch) -> None:
        config, standing = self._config, self._standing
        generator = Generator().manual_seed((config.seed * _LOSS_STREAM + step) * _LOSS_STREAM + self._devices.process)
        for group in self._optimizer.param_groups:
            group["lr"] = learning_rate(step, config)
        self._optimizer.zero_grad()
        losses: dict[str, Tensor] = self._module(vars(batch.to(self._devices.device)), generator)
        self._devices.backward(losses["total"])
        self._devices.clip(self._module, self._optimizer, config.clip_gradient)
        self._optimizer.step()
        for name, value in losses.items():
            standing.sums[name] = standing.sums.get(name, 0.0) + float(value.detach())
        standing.counted += 1
        standing.step += 1

    def _report(self, narrator: TrainNarrator) -> None:
        config, standing = self._config, self._standing
        losses = {name: value / standing.counted for name, value in standing.sums.items()}
        if not math.isfinite(losses["total"]):
            raise ConfigError(
                f"the loss is no longer a number at step {standing.step}; lower training.learning_rate, or go back to"
                f" precision 32-true. The last state in {self._out} is from before"
            )
        now = time.perf_counter()
        per_step = (now - self._clock) / standing.counted
        speed = config.batch * self._devices.processes / per_step
        report = StepReport(standing.step, config.steps, losses, speed, per_step * (config.steps - standing.step))
        self._clock, standing.sums, standing.counted = now, {}, 0
        if self._log is not None:
            rate = {"learning_rate": learning_rate(standing.step - 1, config), "pairs_per_s": speed}
            self._log.losses(standing.step, losses | rate)
            narrator.stepped(report)

    def _validate(self, recordings: Recordings, narrator: TrainNarrator) -> None:
        """Try the network on what it does not learn from, and keep the best."""
        began = time.perf_counter()
        if self._log is not None:
            self._network.eval()
            network, standing = self._network, self._standing
            shown = (recordings.held_out or recordings.learned)[0]
            if not standing.step:
                self._log.inputs(standing.step, shown)
            self._log.turn_scores(standing.step, network, shown, self._devices.device)
            self._save_weights(files.LAST_WEIGHTS, None)
            if recordings.held_out:
                result = validate(network, recordings.held_out, device=self._devices.device)
                self._log.validation(standing.step, result)
                # Where there is nothing to compare with, the last is as good as any.
                is_best = not result.pairs or standing.best is None or score(result) < standing.best
                if is_best:
                    standing.best = score(result)
                    self._save_weights(files.WEIGHTS, result if result.pairs else None)
                narrator.validated(standing.step, result, is_best)
            else:
                self._save_weights(files.WEIGHTS, None)
            self._network.train()
        self._devices.wait()
        self._clock += time.perf_counter() - began

    def _save_weights(self, name: str, result: Validation | None) -> None:
        # Weights are passed on: the names of what they were trained on, not where it lay.
        about = {**self._about, "sources": [Path(source).name for source in self._about.get("sources", ())]}
        if "from" in about:
            about["from"] = Path(about["from"]).name
        about |= {"steps": self._standing.step, "validation": None if result is None else vars(result)}
        config = self._config
        save_checkpoint(self._out / name, checkpoint_of(self._network, config.network, config.images, about))

    def _save(self) -> None:
        if self._log is not None:
            self._standing.loss_scale = self._devices.loss_scale()
            save_state(self._out / files.STATE, self._network, self._plain_optimizer, self._standing)


def score(result: Validation) -> float:
    """One number for a validation, lower is better; infinite where there was nothing to compare with.

    A few pairs that nobody could judge decide the RMS, and the median does not know of bad ones: the mean of both is
    taken, the geometric one, as they differ in size.
    """
    rotation_deg = math.sqrt(result.rotation_rms_deg * result.rotation_median_deg)
    translation_m = math.sqrt(result.translation_rms_m * result.translation_median_m)
    value = rotation_deg / _ROTATION_DEG + translation_m / _TRANSLATION_M
    return value if math.isfinite(value) else math.inf
