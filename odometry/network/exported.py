"""An exported network: what its folder holds, read without torch."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lidarslam.core.errors import InputError
from odometry.images.image_config import ImageConfig
from odometry.network.network_config import NetworkConfig

DESCRIPTION = "network.json"
COLUMNS, TURNS, BIRD, PEAKS, PAIR = "columns.onnx", "turns.onnx", "bird.onnx", "peaks.onnx", "pair.onnx"

_KIND, _VERSION = "a network exported by lidarslam", 1


@dataclass(frozen=True)
class Exported:
    """A folder that `lidarslam export` wrote.

    Attributes:
        folder: where the graphs lie.
        network: which network they are of.
        images: how scans are shown to it.
    """

    folder: Path
    network: NetworkConfig
    images: ImageConfig

    @property
    def graphs(self) -> tuple[str, ...]:
        """Names of the files."""
        return (COLUMNS, TURNS, BIRD, PEAKS) if self.network.name == "correlation" else (PAIR,)


def describe(network: NetworkConfig, images: ImageConfig) -> dict[str, Any]:
    """What is written beside the graphs; values that JSON can hold."""
    return {
        "kind": _KIND,
        "version": _VERSION,
        "network": network.model_dump(mode="json"),
        "images": images.model_dump(mode="json"),
    }


def read_exported(folder: Path) -> Exported:
    """What a folder holds.

    Raises:
        InputError: it holds no exported network, or not all of it, or one of another version.
    """
    try:
        content = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{folder}: holds no exported network ({DESCRIPTION} is missing or damaged);"
            " name a file of weights, or make the folder with `lidarslam export`"
        ) from error
    if not isinstance(content, dict) or content.get("kind") != _KIND or content.get("version") != _VERSION:
        raise InputError(
            f"{folder}: {DESCRIPTION} is not of this program's version; make it again with `lidarslam export`"
        )
    try:
        network = NetworkConfig.model_validate(content.get("network"))
        images = ImageConfig.model_validate(content.get("images"))
    except ValidationError as error:
        raise InputError(f"{folder}: {DESCRIPTION} is damaged; make it again with `lidarslam export`") from error
    exported = Exported(folder, network, images)
    for name in exported.graphs:
        if not (folder / name).is_file():
            raise InputError(f"{folder}: {name} is missing; make the folder again with `lidarslam export`")
    return exported
