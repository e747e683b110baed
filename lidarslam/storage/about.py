"""Which run is unfinished in a directory, and how far its results are: the content of run.json."""

import json
import logging
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, NonNegativeInt, TypeAdapter, with_config
from typing_extensions import TypedDict

from lidarslam.core.errors import InputError
from lidarslam.core.files import cannot_write, replacing
from lidarslam.core.text.json_text import read_json
from lidarslam.storage.directory import ABOUT, UNFINISHED

logger = logging.getLogger(__name__)

# Differences to another run that an error lists.
_LISTED = 3

# At work; stopped, its results so far written; at work, with the results of an earlier run still whole.
Standing = Literal["at work", "stopped", "over an earlier run"]


@with_config(ConfigDict(extra="allow"))
class _Description(TypedDict, total=False):
    source: str
    reader: dict[str, Any]
    merge: Literal["all", "part"]
    sources: list[str]
    parts: list[str]


class _About(TypedDict):
    description: _Description
    standing: Standing
    resumed_after: list[NonNegativeInt]


_SHAPE = TypeAdapter(_About)


@dataclass(frozen=True)
class About:
    """Which run is unfinished; the content of run.json."""

    description: dict[str, Any]  # everything that decides what it computes
    standing: Standing = "at work"
    resumed_after: tuple[int, ...] = ()  # how many scans were done each time it was resumed

    @classmethod
    def read(cls, run: Path) -> "About | None":
        """Of the run in a directory; None where none is unfinished.

        Raises:
            InputError: the file is damaged.
        """
        path = run / ABOUT
        try:
            values = read_json(path, _SHAPE, any_path=True)
            return cls({**values["description"]}, values["standing"], tuple(values["resumed_after"]))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: is damaged ({error}); begin again with --overwrite") from error

    def write(self, run: Path) -> None:
        """Write run.json, durably.

        Raises:
            OSError, OutputError: it cannot be written.
        """
        with replacing(run / ABOUT, durable=True) as partial:
            try:
                partial.write_text(json.dumps(vars(self), indent=2), encoding="utf-8")
            except OSError as error:
                raise cannot_write(run / ABOUT, error) from error

    def remedy(self, run: Path) -> str:
        """What to do about it, as the end of a sentence that begins with the directory."""
        if "merge" not in self.description:
            source = self.description.get("source", "SOURCE")
            return (
                f"this run did not finish; resume it with lidarslam run {source} --out {run} --resume"
                " and the options it was begun with"
            )
        sources = " ".join(self.description.get("sources", ["SOURCE..."]))
        out = run if self.description["merge"] == "all" else run.parent
        return (
            f"this merge did not finish; resume it with lidarslam merge {sources} --out {out} --resume"
            " and the options it was begun with"
        )


def require_whole(run: Path) -> None:
    """Refuse the results of a run that was killed or is at work, unless they are still those of the run before.

    Raises:
        InputError: they are.
    """
    about = About.read(run)
    if about is not None and about.standing == "at work":
        raise InputError(f"{run}: {about.remedy(run)}")
    if about is not None and about.standing == "over an earlier run":
        _warn_of_earlier(run)


@lru_cache
def _warn_of_earlier(run: Path) -> None:
    logger.warning(
        "%s: these are the results of an earlier run; the one that is to replace them is not done: it may be at work,"
        " be resumed with --resume, or be given up by removing the folder %s",
        run,
        run / UNFINISHED,
    )


def require_same(run: Path, was: dict[str, Any], asked: dict[str, Any]) -> None:
    """Refuse to go on with a run that was begun with another description than is asked for.

    Raises:
        InputError: they differ.
    """
    old, new = _flat(was), _flat(asked)
    names = [name for name in [*old, *(n for n in new if n not in old)] if old.get(name) != new.get(name)]
    if names:
        listed = ", ".join(f"{name} {old.get(name)} (now {new.get(name)})" for name in names[:_LISTED])
        more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
        raise InputError(
            f"{run}: was begun with {listed}{more}; give the options it was begun with, or begin again with --overwrite"
        )


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by their dotted names."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
