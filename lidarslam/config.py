"""The whole configuration, composed of the libraries' own; YAML in and out.

Defaults live in the code, beside what consumes them; a file or `--set` holds only what differs.
"""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lidarslam.core.errors import ConfigError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.run_directory import RUN_SECTION
from mapping.config import GlobalMapConfig
from odometry.config import OdometryConfig


class ViewerConfig(BaseModel):
    """What the Rerun recording holds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scan_points: int = Field(20_000, ge=1, description="points of each scan that are shown")
    map_points: int = Field(200_000, ge=1, description="points of the map around the sensor that are shown")
    map_radius_m: float = Field(60.0, gt=0.0, description="how far around the sensor the map is shown")
    map_every: int = Field(20, ge=1, description="the map is shown anew every so many scans")


class Config(BaseModel):
    """Everything that decides what a run computes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reader: ReaderConfig = ReaderConfig()
    odometry: OdometryConfig = OdometryConfig()
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
        raise ConfigError(_explain(error, path)) from None


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
    for key in keys[:-1]:
        branch = tree.setdefault(key, {})
        if not isinstance(branch, dict):
            raise ConfigError(f"--set {setting!r}: {key} is a value, not a section")
        tree = branch
    tree[keys[-1]] = value


def _explain(error: ValidationError, path: Path | None) -> str:
    """One line a fault: the key, what is wrong, and for a misspelt key the likely one."""
    origin = f"{path} or --set" if path else "--set"
    faults = []
    for fault in error.errors():
        location = [str(part) for part in fault["loc"]]
        if fault["type"] == "extra_forbidden":
            faults.append(f"there is no {'.'.join(location)}{_suggest(location)}")
        else:
            faults.append(f"{'.'.join(location)}={fault['input']!r}: {fault['msg'].lower()}")
    return f"configuration ({origin}): " + "; ".join(faults)


def _suggest(location: Sequence[str]) -> str:
    section: Any = Config
    for key in location[:-1]:
        section = section.model_fields[key].annotation
    known = list(section.model_fields)
    close = difflib.get_close_matches(location[-1], known, n=1)
    return f"; did you mean {close[0]}?" if close else f"; there are: {', '.join(known)}"
