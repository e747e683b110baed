"""Independent tasks: where they are carried out, and the way that needs no other process, one after another."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")
OnDone = Callable[[int, Any], None]
"""Called with the index of a task and its result, in the order in which tasks end."""


class Tasks(Protocol):
    """Carries out independent tasks."""

    @property
    def slots(self) -> int:
        """Number of tasks that are carried out at the same time."""

    def run(
        self, function: Callable[[T], R], items: Sequence[T], on_done: OnDone | None = None, ahead: int | None = None
    ) -> Iterator[R]:
        """The results of `function(item)` in the order of the items.

        Args:
            function, items: of a module that can be imported, and to be pickled; the same item always has the same
                result, as a task whose process or machine died is carried out again.
            on_done: called for each task; after Ctrl-C too, for tasks that come to a result nevertheless.
            ahead: number of tasks begun before the result of the first of them is taken; None: all.

        Raises:
            KeyboardInterrupt: Ctrl-C; no task is at work any more.
            LidarSlamError: a task raised it, or its process died repeatedly.
        """


@dataclass(frozen=True)
class Where:
    """Where tasks are carried out."""

    jobs: int = 1  # processes on this machine; 1: this process, one task after another
    cluster: str | None = None  # address of a Ray cluster, whose CPUs are used instead

    @property
    def is_serial(self) -> bool:
        """Whether tasks are carried out in this process."""
        return self.jobs == 1 and self.cluster is None


SERIAL = Where()


class InOrder:
    """One task after another in this process."""

    slots = 1

    def run(
        self,
        function: Callable[[T], R],
        items: Sequence[T],
        on_done: OnDone | None = None,
        ahead: int | None = None,  # noqa: ARG002
    ) -> Iterator[R]:
        """As `Tasks.run`; each task is carried out when its result is asked for."""
        for index, item in enumerate(items):
            result = function(item)
            if on_done is not None:
                on_done(index, result)
            yield result
