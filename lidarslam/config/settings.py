"""The whole configuration, composed of the libraries' own; YAML in and out: plain values, no tags that make objects.

Defaults are in the code, next to their use; a file or `--set` holds only the differences.
"""

import difflib
import re
import reprlib
from collections.abc import Hashable, Iterator, Mapping, Sequence
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import yaml
from annotated_types import Ge, Le
from pydantic import BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from lidarslam.core.errors import ConfigError
from lidarslam.core.settings import Settings
from lidarslam.core.text import one_line
from lidarslam.datasets.config import ReaderConfig
from lidarslam.mapping.config import GlobalMapConfig, MappingConfig, PoseGraphConfig
from lidarslam.odometry.config import OdometryConfig, SimulatedConfig, TrainingConfig
from lidarslam.storage.directory import RUN_SECTION

# A configuration has a few kilobytes.
_LONGEST_BYTES = 4 << 20
_MERGE_TAG = "tag:yaml.org,2002:merge"
# Comments begin at this column at the latest, unless the setting is longer.
_LAST_COLUMN = 48
_FIRST_CLAUSE = re.compile(r"[.;\n]")
# Numbers as YAML 1.2 has them; in 1.1, which PyYAML reads, 010 is eight and 1:30 is ninety.
_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan")
_NUMBERS = {"tag:yaml.org,2002:int": _INT, "tag:yaml.org,2002:float": _FLOAT}


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key that occurs twice in a section; any value that is no decimal number is a text."""

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        tag = super().resolve(kind, value, implicit)  # type: ignore[no-untyped-call]
        is_plain = kind is yaml.ScalarNode and implicit[0] and tag in _NUMBERS
        return self.DEFAULT_SCALAR_TAG if is_plain and not _NUMBERS[tag].fullmatch(value) else tag

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else []:
            key: Any = None if key_node.tag == _MERGE_TAG else self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key is not None:
                if key in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key!r} occurs twice", key_node.start_mark
                    )
                seen.add(key)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str) -> Any:
    """The values of a text; ConfigError where it is not YAML, asks for other objects, or a key occurs twice."""
    try:
        return yaml.load(text, Loader=_StrictLoader)  # noqa: S506 # a SafeLoader that refuses more
    except (yaml.YAMLError, RecursionError, ValueError, AttributeError) as error:  # too deep; a date such as 2021-13-45
        raise ConfigError(f"not YAML: {' '.join(str(error).split())}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a file; ConfigError where it cannot be read, is too long, or has none."""
    try:
        with path.open("rb") as file:
            content = file.read(_LONGEST_BYTES + 1)
        if len(content) > _LONGEST_BYTES:
            raise ConfigError(f"is longer than {_LONGEST_BYTES >> 20} MB; expected a file of settings")
        tree = parse_yaml(content.decode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the file cannot be read ({one_line(str(error))})") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not isinstance(tree, dict | None):
        raise ConfigError(f"{path}: expected keys and values, got a {type(tree).__name__}")
    return tree or {}


def _section(settings: BaseModel, indent: str) -> Iterator[str]:
    values = settings.model_dump(mode="json")
    entries = [(name, field, getattr(settings, name)) for name, field in type(settings).model_fields.items()]
    sections = {name for name, _, value in entries if isinstance(value, BaseModel)}
    plain = {name: f"{indent}{name}: {_flow(values[name])}" for name in values if name not in sections}
    column = min(max(map(len, plain.values()), default=0), _LAST_COLUMN)
    for name, field, value in entries:
        if name in sections:
            if not indent:
                yield ""
            title = field.description or (type(value).__doc__ or "")
            yield f"{indent}# {_FIRST_CLAUSE.split(title.strip())[0]}"
            yield f"{indent}{name}:"
            yield from _section(value, f"{indent}  ")
        else:
            bounds = bounds_text(field)
            comment = " ".join(filter(None, (field.description, bounds and f"[{bounds}]")))
            yield f"{plain[name]:{column}}  # {comment}" if comment else plain[name]


def _flow(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=float("inf"))
    return text.removesuffix("\n").removesuffix("\n...")


def bounds_of(field: FieldInfo) -> tuple[float, float] | None:
    """The least and the largest value of a number, also where it may be null or is in a tuple; None of no number."""
    marks = list(_marks(field.metadata, field.annotation))
    low = next((mark.ge for mark in marks if isinstance(mark, Ge)), None)
    high = next((mark.le for mark in marks if isinstance(mark, Le)), None)
    return None if low is None or high is None else (low, high)  # type: ignore[return-value] # they are numbers


def bounds_text(field: FieldInfo) -> str | None:
    """Bounds in words: `0.01 to 10` or `[3 numbers, 0 to 1]`, or words that may stand instead; None of no number."""
    bounds = bounds_of(field)
    if bounds is None:
        return None
    words = [word for kind in get_args(field.annotation) if get_origin(kind) is Literal for word in get_args(kind)]
    numbers = " to ".join(f"{b:,.0f}" if b == int(b) else f"{b:g}" for b in bounds)
    length = next((len(get_args(kind)) for kind in get_args(field.annotation) if get_origin(kind) is tuple), None)
    return " or ".join([numbers if length is None else f"[{length} numbers, {numbers}]", *words])


def _marks(metadata: list[Any], annotation: Any) -> Iterator[Any]:
    for mark in metadata:
        yield from mark.metadata if isinstance(mark, FieldInfo) else (mark,)
    for part in get_args(annotation):
        yield from _marks(list(getattr(part, "__metadata__", ())), part)


# Sections of config.yaml that are not settings: they describe the run, and the training data.
SOURCES_SECTION = "trained_on"
_DESCRIPTIONS = (RUN_SECTION, SOURCES_SECTION)

_MOST_FAULTS = 5
# Pydantic's names for numbers beyond their bounds, and for words in the place of a number.
_BEYOND = ("greater_than_equal", "less_than_equal", "literal_error")
# Values in messages: their beginning if they are long, as aliases of YAML can make them endless.
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80
_SHORT.maxlong = 40
_short = _SHORT.repr

M = TypeVar("M", bound=BaseModel)


class ViewerConfig(Settings):
    """Contents of the Rerun recording; no effect on the results."""

    scan_points: int = Field(20_000, ge=1, le=10**7, description="points shown per scan")
    map_points: int = Field(200_000, ge=1, le=10**8, description="points shown of the map")
    map_every: int = Field(20, ge=1, le=10**6, description="scans between updates of the map")


class CheckpointConfig(Settings):
    """Saving for --resume; no effect on the results."""

    interval_s: float = Field(
        10.0, ge=0.0, le=1e6, description="least time between checkpoints, which take at most 2 % of it"
    )
    every_scans: int | None = Field(
        None, ge=1, le=10**6, description="scans between checkpoints, instead of interval_s"
    )


class Config(Settings):
    """Everything that determines the results of a run."""

    reader: ReaderConfig = ReaderConfig()
    odometry: OdometryConfig = OdometryConfig()
    mapping: MappingConfig = MappingConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    global_map: GlobalMapConfig = GlobalMapConfig()
    viewer: ViewerConfig = ViewerConfig()
    checkpoints: CheckpointConfig = CheckpointConfig()

    def having(self, section: str, **settings: Any) -> "Config":
        """The configuration with other settings of a section, whose values are not checked."""
        return self.model_copy(update={section: getattr(self, section).model_copy(update=settings)})


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """The defaults, changed by a YAML file and then by settings such as `odometry.kiss_icp.voxel_size_m=0.5`.

    ConfigError where the file is not readable YAML, a key does not exist, or a value does not fit.
    """
    return _load(Config, path, settings, "odometry.kiss_icp.voxel_size_m=0.5")


class TrainConfig(Settings):
    """Everything that determines the results of a training."""

    training: TrainingConfig = TrainingConfig()
    reader: ReaderConfig = ReaderConfig()
    simulated: SimulatedConfig = SimulatedConfig()


def load_train_config(path: Path | None = None, settings: Sequence[str] = ()) -> TrainConfig:
    """The configuration of a training, with settings such as `training.batch=8`; otherwise as `load_config`."""
    return _load(TrainConfig, path, settings, "training.batch=8")


def make_config(given: Config | PathLike[str] | str | Mapping[str, Any] | None) -> Config:
    """A configuration; the path or name of one in YAML; or settings, by sections, keys with dots, or both."""
    if given is None or isinstance(given, Config):
        return given or Config()
    if not isinstance(given, Mapping):
        return load_config(shipped_files(CONFIGS).get(str(given), Path(given)))
    tree: dict[str, Any] = {}
    for dotted, value in given.items():
        _put(tree, str(dotted), value, f"configuration: {dotted}")
    return _validated(Config, tree, "settings")


def _load(model: type[M], path: Path | None, settings: Sequence[str], example: str) -> M:
    """Any configuration: its defaults, changed by a YAML file and then by settings like the example.

    The section of a run's or training's config.yaml about its source is ignored.
    """
    tree = {} if path is None else read_yaml(path)
    for section in _DESCRIPTIONS:
        tree.pop(section, None)
    for setting in settings:
        _apply(tree, setting, example)
    origin = " or ".join(([str(path)] if path else []) + (["--set"] if settings else []))
    return _validated(model, tree, origin)


def _validated(model: type[M], tree: dict[str, Any], origin: str) -> M:
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(_explain(error, model, origin)) from None


def reader_settings(**options: str | None) -> list[str]:
    """The reader's options that were given, as settings; quoted as YAML text, so that sequence 04 stays 04."""
    return [setting(f"reader.{key}", value) for key, value in options.items() if value is not None]


def setting(key: str, text: str) -> str:
    """A setting whose value is a text, even if YAML would read it as a number."""
    quoted = text.replace("'", "''")
    return f"{key}='{quoted}'"


def dump_yaml(config: BaseModel, described: dict[str, Any] | None = None, section: str = RUN_SECTION) -> str:
    """The resolved configuration, after a section that describes the run: each setting with its description."""
    text = "\n".join(_section(config, "")).lstrip("\n") + "\n"
    if described is None:
        return text
    return f"{yaml.safe_dump({section: described}, sort_keys=False, allow_unicode=True)}\n{text}"


def _apply(tree: dict[str, Any], setting: str, example: str) -> None:
    """Set one `key.path=value` in the tree; the value is read as YAML."""
    dotted, separator, text = setting.partition("=")
    keys = dotted.strip().split(".")
    if not separator or not all(keys):
        raise ConfigError(f"--set {_short(setting)}: expected key.path=value, such as {example}")
    try:
        value = parse_yaml(text)
    except ConfigError:
        value = text
    _put(tree, dotted.strip(), value, f"--set {_short(setting)}")


def _put(tree: dict[str, Any], dotted: str, value: Any, what: str) -> None:
    *sections, last = dotted.split(".")
    for key in sections:
        branch = tree.setdefault(key, {})
        if not isinstance(branch, dict):
            raise ConfigError(f"{what}: {key} is a value, not a section")
        tree = branch
    if isinstance(value, Mapping):
        section = tree.setdefault(last, {})
        for key, part in value.items():
            _put(section, str(key), part, what)
    else:
        tree[last] = value


def _explain(error: ValidationError, model: type[BaseModel], origin: str) -> str:
    """All faults in one line: the key, the fault, and for a misspelt key the likely one."""
    # A value that may be one of several kinds has a fault for each, of which the first one has the bounds.
    texts = (_explain_fault(fault, model) for fault in reversed(error.errors(include_url=False)))
    explained = [*{text.partition(": ")[0]: text for text in texts}.values()][::-1]
    further = len(explained) - _MOST_FAULTS
    explained = explained[:_MOST_FAULTS] + ([f"and {further} more"] if further > 0 else [])
    return f"configuration ({origin}): {'; '.join(explained)}"


def _explain_fault(fault: ErrorDetails, model: type[BaseModel]) -> str:
    location = [str(part) for part in fault["loc"]]
    key = ".".join(location)
    depth, section, field = _field_at(location, model)
    if fault["type"] == "extra_forbidden":
        close = difflib.get_close_matches(location[-1], section.model_fields, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are: {', '.join(section.model_fields)}"
        return f"there is no {key}; {hint}"
    if fault["type"] == "model_type":
        return f"{key}={_short(fault['input'])}: expected a section"
    if fault["type"] == "value_error":
        # Keys that contradict each other: the input would be their whole section, the validator names the two.
        return f"{key}: {fault['ctx']['error']}"
    bounds = None if field is None else bounds_text(field)
    if bounds is None:
        return f"{key}={_short(fault['input'])}: {fault['msg'].lower()}"
    expected = f"expected {bounds}" if fault["type"] in _BEYOND else fault["msg"].lower()
    return f"{'.'.join(location[:depth])}={_short(fault['input'])}: {expected}"


def _field_at(location: Sequence[str], model: type[BaseModel]) -> tuple[int, type[BaseModel], FieldInfo | None]:
    """The number of keys to the setting at a place, which a kind or an index may follow; its section; and itself."""
    section, field = model, None
    for depth, key in enumerate(location):
        if key not in section.model_fields:
            return depth, section, field
        field = section.model_fields[key]
        kinds = (field.annotation, *get_args(field.annotation))
        section = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), BaseModel)
    return len(location), section, field


CONFIGS = Path(str(files("lidarslam"))) / "configs"
BENCHMARKS = CONFIGS / "benchmarks"


def shipped_files(folder: Path) -> dict[str, Path]:
    """The YAML files of a folder by their names, without the suffix."""
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def headline(path: Path) -> str:
    """The first line of a file, a comment that describes it."""
    with path.open(encoding="utf-8") as lines:
        return next(lines).removeprefix("#").strip()
