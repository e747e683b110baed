"""Options that several commands share, and the configuration they result in."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import click
from click.shell_completion import CompletionItem

from lidarslam.commands.terminal import note, verbose_option
from lidarslam.core.plugins import PlugPoint

if TYPE_CHECKING:
    from lidarslam.config.settings import Config
    from lidarslam.core.tasks import Where
    from lidarslam.mapping.config import MapFormat
    from lidarslam.mapping.loops.closure import GivenLoops

FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
POSITIVE = click.FloatRange(min=0.0, min_open=True)
_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
# Of the commands that leave a run directory.
POSE_GRAPH = click.option("--pose-graph/--no-pose-graph", default=None, help="Close loops.  [default: no-pose-graph]")
GNSS = click.option(
    "--gnss/--no-gnss",
    default=None,
    help="Hold the pose graph by GNSS positions, and write map and trajectory in UTM, too.  [default: no-gnss]",
)
_SCANS = (click.IntRange(min=0), click.IntRange(min=0))
RERUN = click.option(
    "--rerun",
    type=click.Choice(["off", "save", "web", "spawn"]),
    default="off",
    show_default=True,
    help="Save a Rerun recording; web serves a browser while it is written, and on until Ctrl-C; spawn opens a window.",
)
REPORT = click.option("--report/--no-report", default=True, help="Draw report.html and pictures.  [default: report]")
OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace an earlier run in the directory.")


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


class _CommandWithExample(click.Command):
    """Keeps the line breaks of the examples in its help, and takes `-v`."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The options, with `-v` before `--help`."""
        *own, help_option = super().get_params(ctx)
        return [*own, verbose_option(), help_option]

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        if self.epilog:
            formatter.write_paragraph()
            with formatter.section("Example"):
                for line in self.epilog.strip().splitlines():
                    formatter.write(f"{'':>{formatter.current_indent}}{line.strip()}\n")


def command(example: str, name: str | None = None) -> Callable[[Callable[..., Any]], click.Command]:
    """A command with examples of its use, named after the function unless a name is given."""
    return click.command(name, cls=_CommandWithExample, epilog=example)


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


def _together(*decorators: _Decorator) -> _Decorator:
    """Several options as one decorator, in the order of the help."""

    def apply(function: Callable[..., Any]) -> Callable[..., Any]:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


LOOPS = _together(
    click.option(
        "--loop",
        "loops",
        type=_SCANS,
        multiple=True,
        metavar="I J",
        help="Close a loop between scans I and J, by their indices in the run, from 0; may be repeated.",
    ),
    click.option(
        "--no-loop",
        "no_loops",
        type=_SCANS,
        multiple=True,
        metavar="I J",
        help="Find no loop between scans within 50 of I and of J; may be repeated.",
    ),
)
SOURCE = click.argument("source", type=PATH)

config_options = _together(
    click.option(
        "-c",
        "--config",
        "config_file",
        type=ShippedFile("configuration", "CONFIGS"),
        help="Settings that differ from the defaults: a name of lidarslam config --list, or a YAML file.",
    ),
    click.option("--set", "settings", multiple=True, metavar="KEY.PATH=VALUE", help="One setting; may be repeated."),
)
reader_options = _together(
    click.option(
        "--reader",
        type=Registered("lidarslam.datasets.registry", "ALL_READERS"),
        help="Reader of the source.  [default: recognised]",
    ),
    click.option("--topic", metavar="TOPIC", help="Point cloud topic of a bag with several."),
    click.option("--sequence", metavar="NAME", help="Sequence of a data set's root, such as 04 of KITTI odometry."),
)
scan_options = _together(
    click.option("--start", type=click.IntRange(min=0), default=0, show_default=True, help="First scan."),
    click.option("--stop", type=click.IntRange(min=0), help="Scan to stop before."),
    click.option("--step", type=click.IntRange(min=1), default=1, show_default=True, help="Take every n-th scan."),
)
odometry_options = _together(
    click.option(
        "--odometry",
        type=Registered("lidarslam.odometry.config", "ODOMETRIES", without="external"),
        help="Motion from scan to scan; imu and learned+imu use the recording's IMU.  [default: learned]",
    ),
    click.option(
        "--weights",
        type=click.Path(path_type=Path, exists=True),
        metavar="FILE",
        help="Weights of the learned odometry, or the folder of an exported network.  [default: included]",
    ),
)
mapping_options = _together(
    # With a value or without, which is surfels.
    click.option(
        "--mapping",
        type=Registered("lidarslam.mapping.config", "MAPPINGS"),
        is_flag=False,
        flag_value="surfels",
        help="Register scans to a map of surfels or as LOAM's mapping does.  [default: surfels]",
    ),
    click.option("--no-mapping", is_flag=True, help="The odometry alone, as --mapping off."),
)
map_options = _together(
    click.option(
        "--map-format",
        type=Registered("lidarslam.mapping.config", "MapFormat"),
        multiple=True,
        help="Write the map as map.pcd, map.laz or map.e57 too; may be repeated.",
    ),
    click.option("--pcd", is_flag=True, help="As --map-format pcd."),
)
jobs_options = _together(
    click.option(
        "--jobs",
        type=click.IntRange(min=1),
        default=1,
        show_default=True,
        metavar="N",
        help="Compute in N processes; needs the extra ray.",
    ),
    click.option("--ray", metavar="ADDRESS", help="Compute on a Ray cluster: auto, or HOST:6379 of its head."),
)


def take_map_formats(options: dict[str, Any]) -> "tuple[MapFormat, ...]":
    """The formats of the map besides .ply; the options they are made of are removed.

    Raises:
        OutputError: a library for one is not installed.
    """
    from lidarslam.mapping.global_map.point_cloud import require_format

    formats = (*options.pop("map_format"), *(["pcd"] if options.pop("pcd") else []))
    for one in formats:
        require_format(one)
    return tuple(dict.fromkeys(formats))


def take_loops(options: dict[str, Any]) -> "GivenLoops":
    """The loop closures that are given and forbidden; the options they are made of are removed.

    Raises:
        UsageError: a pair is one scan, or is both.
    """
    from lidarslam.mapping.loops.closure import GivenLoops

    closed, forbidden = (dict.fromkeys((min(p), max(p)) for p in options.pop(name)) for name in ("loops", "no_loops"))
    for first, second in (*closed, *forbidden):
        if first == second:
            raise click.UsageError(f"--loop and --no-loop take two scans, not {first} twice")
    for first, second in closed.keys() & forbidden.keys():
        raise click.UsageError(f"--loop {first} {second} and --no-loop {first} {second} exclude one another")
    return GivenLoops(tuple(closed), tuple(forbidden))


def out_option(what: str, default: str) -> _Decorator:
    """The option `--out`, and where `default_out` puts results without it."""
    return click.option("-o", "--out", type=PATH, metavar="DIR", help=f"{what}  [default: {default}]")


def default_out(folder: str, name: str) -> Path:
    """A new directory FOLDER/NAME_TIME, which is noted."""
    from lidarslam.storage.default_places import new_place

    out = new_place(Path(folder), name)
    note(f"results go to {out}")
    return out


def latest_run() -> Path:
    """The latest run in `runs`, which is noted.

    Raises:
        UsageError: there is none.
    """
    from lidarslam.storage import default_places

    run = default_places.latest_run()
    if run is None:
        raise click.UsageError(f"name a RUN; {default_places.RUNS} holds no finished one")
    note(f"taking the latest run, {run}")
    return run


def take_config(options: dict[str, Any], *sources: Path) -> "Config":
    """The configuration for these sources; the options it is made of are removed, all but the prior.

    Options that a source does not use are noted.

    Raises:
        UsageError: options exclude each other.
        ConfigError, InputError: a file or a setting is invalid, or no reader recognises a source.
    """
    from lidarslam.config.settings import load_config, reader_settings

    reader = {"name": options.pop("reader"), "topic": options.pop("topic"), "sequence": options.pop("sequence")}
    settings = [*options.pop("settings"), *_method_settings(options), *reader_settings(**reader)]
    config = load_config(options.pop("config_file"), settings)
    for source in sources:
        _note_unused(source, config.reader.name, reader["topic"], reader["sequence"])
    return config


def _method_settings(options: dict[str, Any]) -> list[str]:
    """The options of the method as settings; a command may lack some of them."""
    from lidarslam.config.settings import setting

    odometry, weights, prior = options.pop("odometry", None), options.pop("weights", None), options.get("prior")
    settings = []
    if weights is not None:
        if odometry not in (None, "learned", "learned+imu") or prior is not None:
            raise click.UsageError("--weights belongs to --odometry learned; leave it, or the other odometry, out")
        odometry = odometry or "learned"
        settings.append(setting("odometry.learned.weights", str(weights.resolve())))
    if prior is not None:
        if odometry is not None:
            raise click.UsageError("--prior replaces the odometry; leave --odometry out")
        odometry = "external"
    if odometry is not None:
        settings.append(setting("odometry.method", odometry))
    mapping = options.pop("mapping", None)
    if options.pop("no_mapping", False):
        if mapping not in (None, "off"):
            raise click.UsageError(f"--no-mapping is --mapping off, not --mapping {mapping}; leave one of them out")
        mapping = "off"
    if mapping is not None:
        settings.append(setting("mapping.method", mapping))
    pose_graph, gnss = options.pop("pose_graph", None), options.pop("gnss", None)
    if gnss or options.get("loops") or options.get("no_loops"):
        if pose_graph is False:
            raise click.UsageError("--gnss, --loop and --no-loop are of the pose graph; leave --no-pose-graph out")
        pose_graph = True
    if gnss is not None:
        settings.append(f"pose_graph.gnss={str(gnss).lower()}")
    if pose_graph is not None:
        settings.append(f"pose_graph.enabled={str(pose_graph).lower()}")
    return settings


def _note_unused(source: Path, reader: str | None, topic: str | None, sequence: str | None) -> None:
    from lidarslam.datasets.registry import choose_reader, takes_sequence

    chosen = choose_reader(source, reader)
    if topic is not None and chosen != "rosbag":
        note(f"--topic {topic} is ignored: {source} is not a bag ({chosen})")
    if sequence is not None and not takes_sequence(source, chosen):
        note(f"--sequence {sequence} is ignored: {source} is one recording ({chosen})")


class _Gate(click.ParamType):  # type: ignore[type-arg]
    """A bound of a figure, named by the parameter: of `--max` or of `--min`; of a comparison, of one method too."""

    name = "gate"

    def __init__(self, with_method: bool) -> None:
        self._with_method = with_method

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from lidarslam.core.errors import ConfigError
        from lidarslam.evaluation.comparison.gates import parse_gate

        try:
            kind: Literal["max", "min"] = "max" if param is not None and param.name == "maxima" else "min"
            return parse_gate(kind, value, self._with_method)
        except ConfigError as error:
            self.fail(str(error), param, ctx)


def gate_options(with_method: bool) -> _Decorator:
    """The options `--max` and `--min`; their values are `maxima` and `minima`."""
    gate, form = _Gate(with_method), f"{'[METHOD:]' if with_method else ''}NAME=VALUE"
    texts = (
        ("--max", "maxima", "Upper bound of a figure, such as ate=0.1; may be repeated."),
        ("--min", "minima", "Lower bound of a figure, such as f_score_0.1=90; may be repeated."),
    )
    given: dict[str, Any] = {"type": gate, "multiple": True, "metavar": form}
    return _together(*(click.option(*names, help=text, **given) for *names, text in texts))


def take_where(options: dict[str, Any]) -> "Where":
    """Where independent tasks are carried out; the options it is made of are removed.

    Raises:
        UsageError: the options exclude each other.
    """
    from lidarslam.core.tasks import Where

    jobs, cluster = options.pop("jobs"), options.pop("ray")
    if cluster is not None and jobs > 1:
        raise click.UsageError("--jobs is of this machine; a cluster computes as many tasks at once as it has CPUs")
    return Where(jobs, cluster)
