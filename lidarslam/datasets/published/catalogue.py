"""Published data sets, as `catalogue.csv` lists them: where each is found, its sensors, and its reader."""

import csv
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

Tried = Literal["real files", "written sample", "not yet"]


@dataclass(frozen=True)
class DataSet:
    """One data set."""

    name: str  # as the command line has it; evalio's own name where evalio reads it
    title: str
    sensor: str  # the LiDAR whose scans are read
    reader: str  # in the table of readers
    truth: str  # source of the true poses
    imu: bool  # whether samples of an IMU are read, which need gravity in them
    url: str
    layout: str  # the path of a source, and the files that are read
    tried: Tried  # the data its reader was run on
    choose: str = ""  # option that chooses a sequence, where the source does not


_TABLE = files("lidarslam.datasets.published").joinpath("catalogue.csv").read_text(encoding="utf-8")
_ROWS: Any = csv.DictReader(_TABLE.splitlines())
CATALOGUE = tuple(DataSet(**{**row, "imu": row["imu"] == "yes"}) for row in _ROWS)
