"""Objects whose state can be saved and restored, for going on where a run stopped."""

import typing
from typing import Any

from lidarslam.core.state.tree import Saved, State, checked, decode, encode, hints_of
from lidarslam.core.state.values import ANY_NUMBER, TRANSFORM, Shape, Transforms, Within

__all__ = ["ANY_NUMBER", "TRANSFORM", "Saved", "Shape", "State", "Stateful", "Transforms", "Within", "decode"]


@typing.runtime_checkable
class _Restorable(typing.Protocol):
    def state(self) -> State | None: ...
    def restore(self, saved: Saved) -> None: ...


class Stateful:
    """A mutable object whose state can be saved: exactly the attributes annotated in its class body.

    Attributes that are annotated nowhere, or only inside methods, are not saved: settings, caches, open files. An
    attribute that holds a `Stateful` object is restored in place. In lists and optionals such objects are created
    without `__init__`, so that their classes must declare every attribute, or rebuild the others in `_after_restore`.
    """

    def state(self) -> State:
        """The values of all declared attributes; arrays are not copied."""
        return {name: _encode(kind, getattr(self, name)) for name, kind in hints_of(type(self)).items()}

    def restore(self, saved: Saved) -> None:
        """Take over a state.

        Raises:
            InputError: it lacks an attribute, or a value does not fit its hint or the others.
        """
        for name, kind in hints_of(type(self)).items():
            present, tree = getattr(self, name, None), saved.value(name)
            if tree is not None and isinstance(present, _Restorable):
                present.restore(saved.part(name))
            else:
                setattr(self, name, decode(kind, tree, saved.at(name)))
        checked(saved, self._after_restore)

    def _after_restore(self) -> None:
        """Rebuild what is not saved, and check what belongs together; a ValueError refuses the state."""


def _encode(kind: Any, value: Any) -> Any:
    return value.state() if isinstance(value, _Restorable) else encode(kind, value)
