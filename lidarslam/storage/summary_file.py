"""summary.json of a run, read back; `lidarslam.run.summary` writes it."""

from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import ConfigDict, Field, NonNegativeInt, TypeAdapter, with_config
from typing_extensions import TypedDict

from lidarslam.core.errors import InputError
from lidarslam.core.text.json_text import read_json
from lidarslam.storage.directory import SUMMARY

_keeping_others = with_config(ConfigDict(extra="allow"))
_Positive = Annotated[float, Field(gt=0.0)]


@_keeping_others
class _Stretch(TypedDict):
    first: NonNegativeInt
    last: NonNegativeInt


@_keeping_others
class _LostStretch(_Stretch):
    reason: str


@_keeping_others
class _Loop(TypedDict):
    first_scan: int
    second_scan: int
    accepted: bool


@_keeping_others
class _PoseGraph(TypedDict):
    loops: list[_Loop]


@_keeping_others
class _Localisation(TypedDict):
    map: str


@_keeping_others
class _Recording(TypedDict):
    directory: str | None


@_keeping_others
class _Summary(TypedDict, total=False):
    """What is read back, of any version; other keys are kept as they are."""

    scans: NonNegativeInt
    lost_scans: NonNegativeInt
    lost: list[_LostStretch]
    map_contradictions: list[_Stretch]
    length_m: float
    unconstrained_m: float
    map_voxel_size_m: _Positive | None
    map_entropy: float | None
    ms_per_scan: dict[str, dict[str, float | None]]
    pose_graph: _PoseGraph | None
    localisation: _Localisation | None
    recordings: list[_Recording]
    warnings: list[str]


_SHAPE = TypeAdapter(_Summary)

# Share of the way, of a metre at least, that may be unconstrained.
_MOST_UNCONSTRAINED, _SHORTEST_M = 0.1, 1.0


def is_unconstrained(unconstrained_m: float, length_m: float) -> bool:
    """Whether so much of a way lies along directions that hardly any surface constrains that its length is unknown."""
    return unconstrained_m > _MOST_UNCONSTRAINED * max(length_m, _SHORTEST_M)


def read_summary(path: Path) -> dict[str, Any]:
    """The content of a run's summary.json, empty when there is none.

    Raises:
        InputError: it is damaged.
    """
    file = path / SUMMARY
    if not file.is_file():
        return {}
    try:
        return cast(dict[str, Any], read_json(file, _SHAPE))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: not a run's summary ({error}); make the run again") from error
