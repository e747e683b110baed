"""Where a training computes, in which precision, and in how many processes: the only file that knows Lightning."""

import os

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins import MixedPrecision
from torch import Tensor, nn

from lidarslam.core.errors import ConfigError
from lidarslam.train.request import DeviceName
from odometry.training.training_config import Precision


class Devices:
    """The devices of this training; started by torchrun, each process has one."""

    def __init__(self, device: DeviceName, precision: Precision) -> None:
        """Find them.

        Raises:
            ConfigError: the device is not there.
        """
        if device == "cuda" and not torch.cuda.is_available():
            raise ConfigError("--device cuda: PyTorch finds no such device here; leave it out, or choose cpu")
        accelerator = "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
        self.processes = int(os.environ.get("WORLD_SIZE", "1"))
        here = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        # Which parameters are trained depends on the losses; several processes have to agree on it in every step.
        strategy = "ddp_find_unused_parameters_true" if self.processes > 1 else "auto"
        self._fabric = Fabric(
            accelerator=accelerator,
            strategy=strategy,
            devices=here,
            num_nodes=max(1, self.processes // here),
            precision=precision,
        )
        self._fabric.launch()
        self.process = self._fabric.global_rank
        self.device = self._fabric.device

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes and speaks."""
        return self.process == 0

    def set_up(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> tuple[nn.Module, torch.optim.Optimizer]:
        """Both, on the device and in the precision; the optimizer's state moves as well."""
        ready, stepping = self._fabric.setup(module, optimizer)
        return ready, stepping

    def backward(self, loss: Tensor) -> None:
        """Gradients of a loss, added up over the processes."""
        self._fabric.backward(loss)

    def clip(self, module: nn.Module, optimizer: torch.optim.Optimizer, most: float) -> None:
        """Shorten the gradient to at most this norm."""
        self._fabric.clip_gradients(module, optimizer, max_norm=most, error_if_nonfinite=False)

    def wait(self) -> None:
        """Until all processes are here."""
        self._fabric.barrier()

    def any(self, flag: bool) -> bool:
        """Whether it is true in any process."""
        if self.processes == 1:
            return flag
        total = self._fabric.all_reduce(torch.tensor(float(flag), device=self.device), reduce_op="sum")
        return bool(torch.as_tensor(total) > 0.0)

    def loss_scale(self) -> dict[str, float]:
        """The state of the scale that keeps half-precision gradients representable; empty where there is none."""
        scaler = self._scaler()
        return {} if scaler is None else {name: float(value) for name, value in scaler.state_dict().items()}

    def set_loss_scale(self, state: dict[str, float]) -> None:
        """Go on with that scale."""
        scaler = self._scaler()
        if scaler is not None and state:
            scaler.load_state_dict(state)

    def _scaler(self) -> torch.amp.GradScaler | None:
        precision = self._fabric.strategy.precision
        scaler = precision.scaler if isinstance(precision, MixedPrecision) else None
        return scaler if isinstance(scaler, torch.amp.GradScaler) else None
