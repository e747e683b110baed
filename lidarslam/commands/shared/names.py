"""Values of options that are names: of what is registered, and of the YAML files that come with the program."""

from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import click
from click.shell_completion import CompletionItem

from lidarslam.core.plugins import PlugPoint


class Registered(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """One of the names in a registry, a dictionary, Literal or plug point in a module that is imported when needed."""

    name = "name"

    def __init__(self, module: str, registry: str, without: str = "") -> None:
        self._module, self._registry, self._without = module, registry, without

    def _choice(self, given: Any = None) -> "click.Choice[str]":
        registry = getattr(import_module(self._module), self._registry)
        if isinstance(registry, PlugPoint):
            registry = registry.built_in if given in registry.built_in else registry.names
        return click.Choice([name for name in get_args(registry) or registry if name != self._without])

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return self._choice(value).convert(value, param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:  # noqa: ARG002
        return f"[{'|'.join(self._choice().choices)}]"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return self._choice().shell_complete(ctx, param, incomplete)


class ShippedFile(click.ParamType):  # type: ignore[type-arg]
    """A YAML file: one that comes with the program, by its name, or any other, by its path.

    Names have neither slash nor suffix: `./indoor` and `indoor.yaml` are files of the user.
    """

    def __init__(self, kind: str, folder: str) -> None:
        self.name = kind
        self._folder = folder  # a constant of `lidarslam.config.shipped`

    def _files(self) -> dict[str, Path]:
        from lidarslam.config import shipped

        return shipped.shipped_files(getattr(shipped, self._folder))

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        shipped, path = self._files(), Path(value)
        if str(value) not in shipped and (not path.exists() or path.is_dir()):
            names = ", ".join(shipped)
            self.fail(f"{str(value)!r} is neither a file nor the name of a {self.name}; there are: {names}", param, ctx)
        return shipped.get(str(value), path)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:  # noqa: ARG002
        return "NAME|FILE"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002
        names = [CompletionItem(name) for name in self._files() if name.startswith(incomplete)]
        return [CompletionItem(incomplete, type="file"), *names]  # in bash a file discards what came before it
