"""A benchmark file: recordings, methods, tables and published rows, so that a table of a paper is one command."""

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from typing_extensions import Self

from evaluation.comparison.quantities import QUANTITIES
from lidarslam.config.yaml_text import YamlError, read_yaml
from lidarslam.core.errors import ConfigError


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Simulated(_Model):
    """A recording that is made when it is not there; names as in `lidarslam simulate`."""

    world: str = "office"
    sensor: str = "vlp-16"
    motion: str = "handheld"
    speed_mps: float | None = Field(None, gt=0.0, description="null: as the motion and the world have it")
    mount: str = "upright"
    scans: int = Field(300, ge=1)
    seed: int = Field(0, ge=0)
    format: str = "mcap"


class BenchmarkRecording(_Model):
    """One recording; paths are relative to the data's folder."""

    name: str
    source: Path | None = Field(None, description="null only where it is simulated")
    set: tuple[str, ...] = Field((), description="settings for this recording alone, key.path=value")
    start: int = Field(0, ge=0)
    stop: int | None = Field(None, ge=0)
    step: int = Field(1, ge=1)
    prior: Path | None = None
    reference: str | None = Field(None, description="a method's name or a file; null: the benchmark's, or ground truth")
    reference_map: Path | None = None
    simulate: Simulated | None = None

    @model_validator(mode="after")
    def _lies_somewhere_or_is_made(self) -> Self:
        if (self.source is None) == (self.simulate is None):
            raise ValueError(f"recording {self.name}: give either source or simulate")
        return self


class BenchmarkMethod(_Model):
    """A method under a name of its own, with settings of its own."""

    name: str
    method: str = Field(description="as --methods names it")
    set: tuple[str, ...] = Field((), description="settings, key.path=value")


class Published(_Model):
    """A row of somebody's table; a value for each column, null where none was published."""

    method: str
    values: tuple[float | str | None, ...]
    source: str


class BenchmarkTable(_Model):
    """Means over groups of recordings; a column for each group and quantity, the quantities side by side."""

    title: str
    groups: Mapping[str, tuple[str, ...]] = Field(description="heading -> names of recordings")
    quantities: tuple[str, ...]
    published: tuple[Published, ...] = ()
    note: str = ""


class Benchmark(_Model):
    """The whole file."""

    title: str
    recordings: tuple[BenchmarkRecording, ...] = Field(min_length=1)
    methods: tuple[str | BenchmarkMethod, ...] = Field(min_length=1)
    set: tuple[str, ...] = Field((), description="settings for everything, key.path=value")
    reference: str | None = Field(None, description="a method's name; null: ground truth")
    tables: tuple[BenchmarkTable, ...] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        names = [recording.name for recording in self.recordings]
        if len(set(names)) < len(names):
            raise ValueError("two recordings have the same name")
        for table in self.tables:
            _check_table(table, names)
        return self


def _check_table(table: BenchmarkTable, recordings: list[str]) -> None:
    unknown = {name for group in table.groups.values() for name in group} - set(recordings)
    if unknown:
        raise ValueError(f"table {table.title!r} names recordings that are not listed: {', '.join(sorted(unknown))}")
    strange = [name for name in table.quantities if name not in QUANTITIES]
    if strange:
        raise ValueError(
            f"table {table.title!r}: no quantity is called {strange[0]!r}; there are: {', '.join(QUANTITIES)}"
        )
    columns = len(table.groups) * len(table.quantities)
    for row in table.published:
        if len(row.values) != columns:
            raise ValueError(
                f"table {table.title!r}, row {row.method!r}: expected {columns} values, one for each group and"
                f" quantity, got {len(row.values)}"
            )


def load_benchmark(path: Path) -> Benchmark:
    """Read a benchmark file.

    Raises:
        ConfigError: it cannot be read, is not YAML, or does not fit.
    """
    try:
        tree = read_yaml(path)
    except YamlError as error:
        raise ConfigError(f"{path}: {error}") from error
    try:
        return Benchmark.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(f"{path}: {'; '.join(_faults(error))}") from None


def _faults(error: ValidationError) -> list[str]:
    return [
        ": ".join(filter(None, [".".join(map(str, fault["loc"])), fault["msg"].removeprefix("Value error, ")]))
        for fault in error.errors()
    ]
