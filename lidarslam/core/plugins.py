"""Plug points: entry points of other packages in the groups `lidarslam.odometry` etc.; libraries of the extras."""

import logging
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from lidarslam.core.errors import ConfigError
from lidarslam.core.text import one_line

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

logger = logging.getLogger(__name__)

Group = Literal["odometry", "mapping", "reader", "peer", "metric"]


@dataclass(frozen=True)
class PlugPoint:
    """The names of a group: the built-in ones and, searched only when needed, those of other packages.

    Args:
        group: of entry points, without `lidarslam.`.
        built_in: names that no other package can take.
    """

    group: Group
    built_in: tuple[str, ...] = ()

    @property
    def added(self) -> "Mapping[str, EntryPoint]":
        """Those of other packages."""
        return search(self)

    @property
    def names(self) -> tuple[str, ...]:
        """All, the built-in ones first."""
        return (*self.built_in, *self.added)

    def check(self, name: Any) -> Any:
        """The name, where it is one of them; else a ValueError with all of them."""
        if name not in self.built_in and name not in self.names:
            raise ValueError(f"no {self.group} is called {reprlib.repr(name)}; there are: {', '.join(self.names)}")
        return name

    def load(self, name: str, kind: Any) -> Any:
        """The object of another package's entry point; ConfigError where it cannot be imported, or is another kind."""
        try:
            loaded = self.added[name].load()
        except Exception as error:  # another package's code
            why = one_line(f"{type(error).__name__}: {error}")
            raise ConfigError(f"{self._origin(name)} cannot be loaded ({why}); repair or uninstall that") from error
        return self._of_kind(name, loaded, kind)

    def make(self, name: str, kind: Any, *arguments: object) -> Any:
        """The result of a callable that is loaded likewise."""
        return self._of_kind(name, self.load(name, Callable)(*arguments), kind)

    def _of_kind(self, name: str, given: Any, kind: Any) -> Any:
        if not isinstance(given, kind):
            raise ConfigError(f"{self._origin(name)}: expected a {kind.__name__}, got a {type(given).__name__}")
        return given

    def _origin(self, name: str) -> str:
        return f"the {self.group} {name!r} of the package {_package(self.added[name])}"


@cache
def search(point: PlugPoint) -> "Mapping[str, EntryPoint]":
    """The entry points of other packages, by name; a name that is taken is left out with a warning."""
    from importlib.metadata import entry_points  # slow, as the search is

    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=f"lidarslam.{point.group}"):
        if entry.name in point.built_in or entry.name in found:
            logger.warning("the %s %r of %s is ignored: the name is taken", point.group, entry.name, _package(entry))
        else:
            found[entry.name] = entry
    return found


@cache
def usable(point: PlugPoint, kind: Any) -> Mapping[str, Any]:
    """The objects of other packages, by name; those that cannot be loaded are left out with a warning."""
    found = {}
    for name in point.added:
        try:
            found[name] = point.load(name, kind)
        except ConfigError as error:
            logger.warning("%s", error)
    return found


def require_library(library: str, purpose: str, install: str) -> Any:
    """A library that not every installation has; ConfigError with the command that installs it where it is missing."""
    try:
        return import_module(library)
    except ModuleNotFoundError as error:
        missing = (error.name or library).partition(".")[0]
        raise ConfigError(f"{missing} is not installed, which {purpose}; {install}") from error


def _package(entry: "EntryPoint") -> str:
    return entry.value if entry.dist is None else entry.dist.name
