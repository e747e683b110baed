"""Options that several commands share; `lidarslam config`: the configuration they result in."""

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import click
from click.shell_completion import CompletionItem

from lidarslam.commands.terminal import note, say, verbose_option
from lidarslam.core.errors import ConfigError
from lidarslam.core.plugins import PlugPoint
from lidarslam.core.text import printable

if TYPE_CHECKING:
    from lidarslam.config.settings import Config
    from lidarslam.core.tasks import Where

FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
POSITIVE = click.FloatRange(min=0.0, min_open=True)
_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


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
        self._folder = folder  # a constant of `lidarslam.config.settings`

    def _files(self) -> dict[str, Path]:
        from lidarslam.config import settings

        return settings.shipped_files(getattr(settings, self._folder))

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


class _Command(click.Command):
    """Keeps the line breaks of the examples in its help, takes `-v`, and ends with the exit status that is returned."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The options, with `-v` before `--help`."""
        *own, help_option = super().get_params(ctx)
        return [*own, verbose_option(), help_option]

    def invoke(self, ctx: click.Context) -> None:
        ctx.exit(super().invoke(ctx) or 0)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        if self.epilog:
            formatter.write_paragraph()
            with formatter.section("Example"):
                for line in self.epilog.strip().splitlines():
                    formatter.write(f"{'':>{formatter.current_indent}}{line.strip()}\n")


def command(example: str, name: str | None = None) -> Callable[[Callable[..., Any]], click.Command]:
    """A command with examples of its use, named after the function unless a name is given."""
    return click.command(name, cls=_Command, epilog=example)


class _Path(click.Path):
    """A path that is not empty, which would mean the current folder.

    For evalio:DATASET/SEQUENCE, its folder; for the URL of a source, where that is fetched to.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from lidarslam.datasets.fetched import fetched, is_url
        from lidarslam.datasets.published.evalio import located

        if value == "":
            self.fail("the path is empty; name a file or a folder", param, ctx)
        if is_url(value):
            if not isinstance(param, click.Argument):
                self.fail("is a URL; only sources are fetched, name a path", param, ctx)
            return fetched(value)
        path = super().convert(value, param, ctx)
        return located(path) if isinstance(path, Path) else path


PATH = _Path(path_type=Path)


def together(*decorators: _Decorator) -> _Decorator:
    """Several options as one decorator, in the order of the help."""

    def apply(function: Callable[..., Any]) -> Callable[..., Any]:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


SOURCE = click.argument("source", type=PATH)

config_options = together(
    click.option(
        "-c",
        "--config",
        "config_file",
        type=ShippedFile("configuration", "CONFIGS"),
        help="Settings that differ from the defaults: a name of lidarslam config --list, or a YAML file.",
    ),
    click.option("--set", "settings", multiple=True, metavar="KEY.PATH=VALUE", help="One setting; may be repeated."),
)
reader_options = together(
    click.option(
        "--reader",
        type=Registered("lidarslam.datasets.registry", "ALL_READERS"),
        help="Reader of the source.  [default: recognised]",
    ),
    click.option("--topic", metavar="TOPIC", help="Point cloud topic of a bag with several."),
    click.option("--sequence", metavar="NAME", help="Sequence of a data set's root, such as 04 of KITTI odometry."),
)
scan_options = together(
    click.option("--start", type=click.IntRange(min=0), default=0, help="First scan."),
    click.option("--stop", type=click.IntRange(min=0), help="Scan to stop before."),
    click.option("--step", type=click.IntRange(min=1), default=1, help="Take every n-th scan."),
)
jobs_options = together(
    click.option(
        "--jobs",
        type=click.IntRange(min=1),
        default=1,
        metavar="N",
        help="Compute in N processes; needs the extra ray.",
    ),
    click.option("--ray", metavar="ADDRESS", help="Compute on a Ray cluster: auto, or HOST:6379 of its head."),
)


def out_option(what: str, default: str) -> _Decorator:
    """The option `--out`, and where `default_out` puts results without it."""
    return click.option("-o", "--out", type=PATH, metavar="DIR", help=f"{what}  [default: {default}]")


def default_out(folder: str, name: str) -> Path:
    """A new directory FOLDER/NAME_TIME, which is noted."""
    from lidarslam.storage.finished_run import new_place

    out = new_place(Path(folder), name)
    note(f"results go to {out}")
    return out


def latest_run() -> Path:
    """The latest run in `runs`, which is noted; UsageError where there is none."""
    from lidarslam.storage import finished_run

    run = finished_run.latest_run()
    if run is None:
        raise click.UsageError(f"name a RUN; {finished_run.RUNS} holds no finished one")
    note(f"taking the latest run, {run}")
    return run


def take_config(options: dict[str, Any], *sources: Path) -> "Config":
    """The configuration for these sources; the options it is made of are removed, all but the prior.

    Options that a source does not use are noted.
    """
    from lidarslam.config.settings import load_config, reader_settings
    from lidarslam.datasets.registry import choose_reader, takes_sequence

    reader = {"name": options.pop("reader"), "topic": options.pop("topic"), "sequence": options.pop("sequence")}
    settings = [*options.pop("settings"), *_method_settings(options), *reader_settings(**reader)]
    config = load_config(options.pop("config_file"), settings)
    topic, sequence = reader["topic"], reader["sequence"]
    for source in sources:
        chosen = choose_reader(source, config.reader.name)
        if topic is not None and chosen != "rosbag":
            note(f"--topic {topic} is ignored: {source} is not a bag ({chosen})")
        if sequence is not None and not takes_sequence(source, chosen):
            note(f"--sequence {sequence} is ignored: {source} is one recording ({chosen})")
    return config


def _method_settings(options: dict[str, Any]) -> list[str]:
    """The options of the method as settings; a command may lack some of them."""
    from lidarslam.config.settings import setting

    odometry, weights, prior = options.pop("odometry", None), options.pop("weights", None), options.get("prior")
    if weights is not None and (odometry not in (None, "learned", "learned+imu") or prior is not None):
        raise click.UsageError("--weights belongs to --odometry learned; leave it, or the other odometry, out")
    if prior is not None and odometry is not None:
        raise click.UsageError("--prior replaces the odometry; leave --odometry out")
    mapping, no_mapping = options.pop("mapping", None), options.pop("no_mapping", False)
    if no_mapping and mapping not in (None, "off"):
        raise click.UsageError(f"--no-mapping is --mapping off, not --mapping {mapping}; leave one of them out")
    pose_graph, gnss = options.pop("pose_graph", None), options.pop("gnss", None)
    needs_graph = gnss or options.get("loops") or options.get("no_loops")
    if needs_graph and pose_graph is False:
        raise click.UsageError("--gnss, --loop and --no-loop are of the pose graph; leave --no-pose-graph out")
    given = {
        "odometry.learned.weights": weights and str(weights.resolve()),
        "odometry.method": "external" if prior is not None else odometry or (weights and "learned"),
        "mapping.method": "off" if no_mapping else mapping,
        "pose_graph.gnss": gnss,
        "pose_graph.enabled": True if needs_graph else pose_graph,
    }
    return [
        f"{key}={str(value).lower()}" if isinstance(value, bool) else setting(key, value)
        for key, value in given.items()
        if value is not None
    ]


def gate_options(with_method: bool) -> _Decorator:
    """The options `--max` and `--min`, in a comparison also of one method; their values are `maxima` and `minima`."""

    def parse(_ctx: click.Context, param: click.Parameter, bounds: tuple[str, ...]) -> tuple[Any, ...]:
        from lidarslam.evaluation.comparison.gates import parse_gate

        kind: Literal["max", "min"] = "max" if param.name == "maxima" else "min"
        try:
            return tuple(parse_gate(kind, bound, with_method) for bound in bounds)
        except ConfigError as error:
            raise click.BadParameter(str(error)) from None

    form = f"{'[METHOD:]' if with_method else ''}NAME=VALUE"
    given: dict[str, Any] = {"callback": parse, "multiple": True, "metavar": form}
    return together(
        click.option("--max", "maxima", help="Upper bound of a figure, such as ate=0.1; may be repeated.", **given),
        click.option("--min", "minima", help="Lower bound, such as f_score_0.1=90; may be repeated.", **given),
    )


def take_where(options: dict[str, Any]) -> "Where":
    """Where independent tasks are carried out; the options it is made of are removed."""
    from lidarslam.core.tasks import Where

    jobs, cluster = options.pop("jobs"), options.pop("ray")
    if cluster is not None and jobs > 1:
        raise click.UsageError("--jobs is of this machine; a cluster computes as many tasks at once as it has CPUs")
    return Where(jobs, cluster)


@command(
    """lidarslam config --list
    lidarslam config -c indoor --set odometry.kiss_icp.voxel_size_m=0.5
    lidarslam config --train -c train_fine_tune"""
)
@click.option("--list", "listing", is_flag=True, help="List the bundled configurations and benchmarks.")
@click.option("--train", "is_training", is_flag=True, help="Print the configuration of lidarslam train.")
@config_options
def config(listing: bool, is_training: bool, config_file: Path | None, settings: tuple[str, ...]) -> None:
    """Print the resolved configuration as YAML."""
    from lidarslam.config.settings import dump_yaml, load_config, load_train_config

    if listing:
        say("\n".join(_shipped()))
        return
    load = load_train_config if is_training else load_config
    click.echo(printable(dump_yaml(load(config_file, settings))), nl=False)


def _shipped() -> Iterator[str]:
    from lidarslam.config.settings import BENCHMARKS, CONFIGS, headline, read_yaml, shipped_files

    kinds = {"--config NAME": shipped_files(CONFIGS), "compare --benchmark NAME": shipped_files(BENCHMARKS)}
    width = max(len(name) for files in kinds.values() for name in files) + 2
    for kind, files in kinds.items():
        yield kind
        for name, path in files.items():
            yield f"  {name:<{width}}{headline(path)}"
            if data := read_yaml(path).get("data"):
                yield f"  {'':<{width}}--data: {data}"
    yield f"The files are in {CONFIGS}"
