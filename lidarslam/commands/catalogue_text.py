"""Output of `lidarslam datasets`: the published data sets, and which of them are on disk."""

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from difflib import get_close_matches
from pathlib import Path
from textwrap import fill
from typing import Any

from lidarslam.core.errors import InputError
from lidarslam.core.text import count, one_line
from lidarslam.datasets.published import evalio
from lidarslam.datasets.published.catalogue import CATALOGUE, DataSet
from lidarslam.datasets.registry import recordings_in

OnDisk = Mapping[str, Sequence[Path]]
"""Recordings by the name of their data set."""

_WIDTH = 100


def choose(arguments: Sequence[str]) -> tuple[list[DataSet], list[Path]]:
    """The data sets and the folders among the arguments of the command; InputError where one is neither."""
    known = {one.name: one for one in CATALOGUE}
    chosen, folders = [], []
    for argument in arguments:
        name = argument.removeprefix(evalio.PREFIX)
        if name in known:
            chosen.append(known[name])
        elif Path(argument).exists():
            folders.append(Path(argument))
        else:
            close = get_close_matches(name.lower(), known, n=3, cutoff=0.5)
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise InputError(f"{argument}: neither a known data set nor a folder{hint} lidarslam datasets lists them")
    return chosen, folders


def find_on_disk(folders: Sequence[Path]) -> OnDisk:
    """Recordings of known data sets in evalio's data folder and in these, down to three folders below."""
    readers = {one.reader: one.name for one in CATALOGUE if one.reader != "evalio"}
    found: dict[str, list[Path]] = defaultdict(list)
    places = map(Path.absolute, [evalio.data_folder(), *folders])
    for path, reader in dict(recordings_in(places, but="rosbag")).items():  # bags may lie beside data sets
        if (name := path.parent.name if reader == "evalio" else readers.get(reader)) is not None:
            found[name].append(path)
    return found


def list_data_sets(on_disk: OnDisk) -> str:
    """One line per data set, and how to continue."""
    rows = [("name", "sensor", "reader", "truth", "IMU", "on disk")]
    for one in CATALOGUE:
        there = count(len(on_disk[one.name]), "recording") if on_disk.get(one.name) else "-"
        rows.append((one.name, one.sensor, one.reader, one.truth, "yes" if one.imu else "no", there))
    widths = [max(map(len, column)) + 2 for column in zip(*rows, strict=True)]
    lines = ["".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    places = f"looked for in {evalio.data_folder()} (EVALIO_DATA) and in folders that are named"
    return "\n".join([*lines, "", places, "more about one, with its sequences: lidarslam datasets hilti_2022"])


def describe_data_set(one: DataSet, on_disk: OnDisk) -> str:
    """All known facts about one data set."""
    rows = list(_rows(one, on_disk.get(one.name, ())))
    wrapped = {"width": _WIDTH, "break_long_words": False, "break_on_hyphens": False, "subsequent_indent": 11 * " "}
    lines = (fill(f"{label:<11}{one_line(text, 8000)}", **wrapped) for label, text in rows)  # type: ignore[arg-type]
    return "\n".join([one.title, *lines])


def _rows(one: DataSet, found: Sequence[Path]) -> Iterator[tuple[str, str]]:
    known = {"name": one.name, "sensor": one.sensor, "truth": one.truth, "IMU": "yes" if one.imu else "no"}
    yield from (known | {"page": one.url, "layout": one.layout}).items()
    sequences = _sequences(one)
    if sequences:
        yield "sequences", ", ".join(sequences)
    if one.reader == "evalio":
        sequence = sequences[0] if sequences else "SEQUENCE"
        yield "reader", "evalio" if sequences else "evalio, which is not installed: pip install 'lidarslam[datasets]'"
        yield "download", evalio.how_to_get(evalio.data_folder() / one.name / sequence)
        yield "run", f"lidarslam run {evalio.PREFIX}{one.name}/{sequence}"
    else:
        yield "reader", one.reader
        yield "download", "from its page, under its licence"
        yield "run", " ".join(["lidarslam run FOLDER", one.choose]).strip()
    yield "tried", one.tried
    yield from (("on disk" if index == 0 else "", str(path)) for index, path in enumerate(found))


def _sequences(one: DataSet) -> tuple[str, ...]:
    return evalio.sequences().get(one.name, ()) if one.reader == "evalio" else ()


def as_json(chosen: Sequence[DataSet], on_disk: OnDisk) -> str:
    """The facts of the table as JSON, with the paths on disk and, of single ones, the sequences that evalio has."""

    def content(one: DataSet) -> dict[str, Any]:
        paths = [str(path) for path in on_disk.get(one.name, ())]
        return {**asdict(one), "sequences": list(_sequences(one)) if chosen else [], "on_disk": paths}

    return json.dumps([content(one) for one in chosen or CATALOGUE], indent=2)
