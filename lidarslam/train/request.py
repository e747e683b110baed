"""What is to be trained, who is told how it goes, and what it came to."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lidarslam.train.config import TrainConfig
from odometry.training.training import Validation

DeviceName = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class TrainRequest:
    """What is to be trained, on what, and where it goes.

    Attributes:
        sources: recordings; may be none where the configuration names simulated ones.
        out: the directory of the training.
        config: how it is trained.
        start_from: weights to begin with instead of random ones.
        device: where to compute.
        prepared: where recordings that are ready for training are kept; None: in `out`.
        resume: go on with the training in `out`.
        overwrite: replace it.
    """

    sources: tuple[Path, ...]
    out: Path
    config: TrainConfig
    start_from: Path | None = None
    device: DeviceName = "auto"
    prepared: Path | None = None
    resume: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class StepReport:
    """A line of the log.

    Attributes:
        step, steps: how many are done, of how many.
        losses: means since the last line, of the total and its parts.
        pairs_per_s: likewise.
        left_s: seconds that the rest will take at that speed.
    """

    step: int
    steps: int
    losses: dict[str, float]
    pairs_per_s: float
    left_s: float


@dataclass(frozen=True)
class Material:
    """What is trained on.

    Attributes:
        recordings: how many there are, those held out and the simulated ones included.
        simulated: how many of them are simulations.
        scans, held_out_scans: that are learned from, and that are kept for validation.
        believed_percent: of the pairs learned from, those of which alignment is sure.
        device, processes: where it is computed, and by how many.
    """

    recordings: int
    simulated: int
    scans: int
    held_out_scans: int
    believed_percent: float
    device: str
    processes: int


class TrainNarrator:
    """Is told how a training goes, and says nothing; others say it."""

    def preparing(self, done: int, total: int) -> None:
        """So many of all scans are ready."""

    def material(self, material: Material) -> None:
        """All recordings are ready."""

    def going_on(self, step: int) -> None:
        """An earlier training is taken up after this step."""

    def stepped(self, report: StepReport) -> None:
        """Some steps were done."""

    def validated(self, step: int, result: Validation, is_best: bool) -> None:
        """The network was tried on what it does not learn from."""


@dataclass(frozen=True)
class TrainOutcome:
    """What a training came to.

    Attributes:
        steps: how many are done.
        interrupted: whether it was ended before its last step.
        weights: the file to use.
        best: the validation of these weights, None when there was none.
        is_first: whether this is the process, of several, that speaks.
    """

    steps: int
    interrupted: bool
    weights: Path
    best: Validation | None
    is_first: bool = True


Interrupted = Callable[[], bool]
"""Whether the training has been asked to end."""
