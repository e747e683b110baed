"""The device of a training, and the processes that torchrun starts: one for each device."""

import os
from typing import Literal

import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

from lidarslam.core.errors import ConfigError

DeviceName = Literal["auto", "cpu", "cuda"]


class Devices:
    """The device of this process, and its place among the others.

    Attributes:
        device: of this process.
        processes: how many there are.
        process: number of this one; the first writes and speaks.

    Raises:
        ConfigError: the device is not there.
    """

    def __init__(self, name: DeviceName) -> None:
        if name == "cuda" and not torch.cuda.is_available():
            raise ConfigError("--device cuda: PyTorch finds no such device here; leave it out, or choose cpu")
        is_cuda = name != "cpu" and torch.cuda.is_available()
        self.device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if is_cuda else torch.device("cpu")
        self.processes = int(os.environ.get("WORLD_SIZE", "1"))
        self.process = int(os.environ.get("RANK", "0")) if self.processes > 1 else 0
        if is_cuda:
            torch.cuda.set_device(self.device)
        if self.processes > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if is_cuda else "gloo")

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes and speaks."""
        return self.process == 0

    def shared(self, module: nn.Module) -> nn.Module:
        """A module on the device, with gradients averaged over the processes."""
        if self.processes == 1:
            return module
        # Which parameters have a gradient depends on the losses.
        return DistributedDataParallel(module, find_unused_parameters=True)

    def wait(self) -> None:
        """Until all processes are here."""
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
