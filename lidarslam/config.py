"""The whole configuration, composed of the libraries' own; YAML in and out.

Defaults live in the code, beside what consumes them; a file or `--set` holds only what differs.
"""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from lidarslam.core.errors import ConfigError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.run_directory import RUN_SECTION
from mapping.config import GlobalMapConfig, MappingConfig
from odometry.config import OdometryConfig

# PyYAML lets Python's own errors through for what has the form or the tag of a date or a number: 2021-13-45.
_UNREADABLE_VALUE = (ValueError, AttributeError)


class ViewerConfig(BaseModel):
    """What the Rerun recording holds."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scan_points: int = Field(20_000, ge=1, description="points of each scan that are shown")
    map_points: int = Field(200_000, ge=1, description="points of the map around the sensor that are shown")
    map_radius_m: float = Field(60.0, gt=0.0, description="how far around the sensor the map is shown")
    map_every: int = Field(20, ge=1, description="the map is shown anew every so many scans")


class Config(BaseModel):
    """Everything that decides what a run computes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reader: ReaderConfig = ReaderConfig()
    odometry: OdometryConfig = OdometryConfig()
    mapping: MappingConfig = MappingConfig()
    global_map: GlobalMapConfig = GlobalMapConfig()
    viewer: ViewerConfig = ViewerConfig()


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """The defaults, changed by a YAML file and then by settings such as `odometry.kiss_icp.voxel_size_m=0.5`.

    Raises:
        ConfigError: the file is not readable YAML, a key does not exist, or a value does not fit.
    """
    tree = {} if path is None else _read_yaml(path)
    tree.pop(RUN_SECTION, None)
    for setting in settings:
        _apply(tree, setting)
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(_explain(error, _origin(path, settings))) from None


def reader_settings(**options: str | None) -> list[str]:
    """The reader's options that were given, as settings; quoted as YAML text, so that sequence 04 stays 04."""
    quoted = {key: value.replace("'", "''") for key, value in options.items() if value is not None}
    return [f"reader.{key}='{value}'" for key, value in quoted.items()]


def resolved(config: Config) -> Config:
    """The configuration with what depends on other choices filled in."""
    if config.odometry.method is not None:
        return config
    method = "constant-velocity" if config.mapping.enabled else "kiss-icp"
    return config.model_copy(update={"odometry": config.odometry.model_copy(update={"method": method})})


def dump_yaml(config: Config, run: dict[str, Any] | None = None) -> str:
    """The resolved configuration as YAML; `run` becomes the section that says what was run."""
    tree: dict[str, Any] = {} if run is None else {RUN_SECTION: run}
    return str(yaml.safe_dump(tree | config.model_dump(mode="json"), sort_keys=False, allow_unicode=True))


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the configuration cannot be read ({error})") from error
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: not YAML: {reason}") from error
    except _UNREADABLE_VALUE as error:
        raise ConfigError(f"{path}: a value looks like a date or a number but is none: {error}") from error
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: expected keys and values, got a {type(tree).__name__}")
    return tree


def _apply(tree: dict[str, Any], setting: str) -> None:
    """Set one `key.path=value` in the tree; the value is read as YAML."""
    dotted, separator, text = setting.partition("=")
    keys = dotted.strip().split(".")
    if not separator or not all(keys):
        raise ConfigError(f"--set {setting!r}: expected key.path=value, such as odometry.kiss_icp.voxel_size_m=0.5")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        value = text
    except _UNREADABLE_VALUE as error:
        raise ConfigError(f"--set {setting!r}: the value looks like a date or a number but is none: {error}") from error
    for key in keys[:-1]:
        branch = tree.setdefault(key, {})
        if not isinstance(branch, dict):
            raise ConfigError(f"--set {setting!r}: {key} is a value, not a section")
        tree = branch
    tree[keys[-1]] = value


def _origin(path: Path | None, settings: Sequence[str]) -> str:
    """Where a fault can have come from: the file, the settings, or either."""
    return " or ".join(([str(path)] if path else []) + (["--set"] if settings else []))


def _explain(error: ValidationError, origin: str) -> str:
    """All faults in one line: the key, what is wrong, and for a misspelt key the likely one."""
    return f"configuration ({origin}): " + "; ".join(_explain_fault(fault) for fault in error.errors())


def _explain_fault(fault: ErrorDetails) -> str:
    location = [str(part) for part in fault["loc"]]
    key = ".".join(location)
    if fault["type"] == "extra_forbidden":
        return f"there is no {key}{_suggest(location)}"
    if fault["type"] == "model_type":
        return f"{key}={fault['input']!r}: expected a section"
    if fault["type"] == "value_error":
        # Keys that contradict each other: the input would be their whole section, the validator names the two.
        return f"{key}: {fault['ctx']['error']}"
    return f"{key}={fault['input']!r}: {fault['msg'].lower()}"


def _suggest(location: Sequence[str]) -> str:
    section: Any = Config
    for key in location[:-1]:
        section = section.model_fields[key].annotation
    known = list(section.model_fields)
    close = difflib.get_close_matches(location[-1], known, n=1)
    return f"; did you mean {close[0]}?" if close else f"; there are: {', '.join(known)}"
