"""Options that several commands share, the values they take, and what they come to in the configuration."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from lidarslam.commands.terminal import tell


class CommandWithExample(click.Command):
    """Keeps the line breaks of the examples in its help."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        if self.epilog:
            formatter.write_paragraph()
            with formatter.section("Example"):
                for line in self.epilog.strip().splitlines():
                    formatter.write(f"{'':>{formatter.current_indent}}{line.strip()}\n")


class _Path(click.Path):
    """A path that is not empty, which would mean the folder one stands in."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the path is empty; name a file or a folder", param, ctx)
        return super().convert(value, param, ctx)


class Registered(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """One of the names in a registry, which is imported when they are asked for."""

    name = "name"

    def __init__(self, names: Callable[[], Iterable[str]]) -> None:
        self._names = names

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return click.Choice(list(self._names())).convert(value, param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:  # noqa: ARG002
        return f"[{'|'.join(self._names())}]"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return click.Choice(list(self._names())).shell_complete(ctx, param, incomplete)


PATH = _Path(path_type=Path)
FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def _together(*decorators: _Decorator) -> _Decorator:
    """Several options as one decorator, in the order of the help."""

    def apply(function: Callable[..., Any]) -> Callable[..., Any]:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


SOURCE = click.argument("source", type=PATH)

config_options = _together(
    click.option("--config", "config_file", type=FILE, help="YAML file with whatever differs from the defaults."),
    click.option("--set", "settings", multiple=True, metavar="KEY.PATH=VALUE", help="One value; may be repeated."),
)


def _readers() -> Iterable[str]:
    from lidarslam.datasets.registry import READERS

    return READERS


reader_options = _together(
    click.option(
        "--reader", type=Registered(_readers), help="Reader to use instead of the one that recognises the source."
    ),
    click.option("--topic", metavar="TOPIC", help="Point cloud topic of a bag that holds several."),
    click.option("--sequence", metavar="NN", help="Sequence of a KITTI odometry root, such as 04."),
)

scan_options = _together(
    click.option("--start", type=click.IntRange(min=0), default=0, show_default=True, help="First scan."),
    click.option("--stop", type=click.IntRange(min=0), help="Scan to stop before."),
    click.option("--step", type=click.IntRange(min=1), default=1, show_default=True, help="Take every n-th scan."),
)

odometry_options = _together(
    click.option(
        "--odometry",
        type=click.Choice(["learned", "kiss-icp", "constant-velocity"]),
        help="Where the motion between scans comes from.  [default: learned]",
    ),
    click.option(
        "--weights", type=FILE, metavar="FILE", help="Of the learned odometry.  [default: those of the program]"
    ),
)


def resolve(config_file: Path | None, settings: tuple[str, ...], **reader: str | None) -> Any:
    """The configuration (`lidarslam.config.settings.Config`), with the options applied last.

    Raises:
        ConfigError: a file or a setting is not what it should be.
    """
    from lidarslam.config.settings import load_config, reader_settings

    return load_config(config_file, [*settings, *reader_settings(**reader)])


def take_config(options: dict[str, Any], settings: tuple[str, ...], *sources: Path) -> Any:
    """The configuration for these sources, its options taken out of a command's; what they have no use for is told.

    Raises:
        ConfigError, InputError: a file or a setting is not what it should be, or nothing reads a source.
    """
    reader = {"name": options.pop("reader"), "topic": options.pop("topic"), "sequence": options.pop("sequence")}
    config = resolve(options.pop("config_file"), settings, **reader)
    for source in sources:
        _warn_of_ignored(source, config.reader.name, reader["topic"], reader["sequence"])
    return config


def _warn_of_ignored(source: Path, reader: str | None, topic: str | None, sequence: str | None) -> None:
    """Say which of the reader's options the source has no use for.

    Raises:
        InputError: the source is not there, or nothing reads it.
    """
    from lidarslam.datasets.registry import choose_reader

    chosen = choose_reader(source, reader)
    if topic is not None and chosen != "rosbag":
        tell(f"--topic {topic} is ignored; {source} is no bag ({chosen})")
    if sequence is not None and chosen != "kitti-odometry":
        tell(f"--sequence {sequence} is ignored; {source} is no KITTI odometry ({chosen})")


def method_settings(
    odometry: str | None,
    weights: Path | None,
    prior: Path | None,
    mapping: bool | None,
    pose_graph: bool | None,
    settings: tuple[str, ...],
) -> tuple[str, ...]:
    """The settings, and those that the options of the method stand for; None where an option was not given.

    Raises:
        UsageError: options exclude each other.
    """
    from lidarslam.config.settings import setting

    if weights is not None:
        if odometry not in (None, "learned") or prior is not None:
            raise click.UsageError(
                "--weights are those of the learned odometry; leave them, or the other odometry, out"
            )
        odometry, settings = "learned", (*settings, setting("odometry.learned.weights", str(weights.resolve())))
    if prior is not None:
        if odometry is not None:
            raise click.UsageError("--prior is an odometry of its own; leave --odometry out")
        odometry = "external"
    if odometry is not None:
        settings = (*settings, f"odometry.method={odometry}")
    switches = {"mapping.enabled": mapping, "pose_graph.enabled": pose_graph}
    return (*settings, *(f"{key}={str(on).lower()}" for key, on in switches.items() if on is not None))
