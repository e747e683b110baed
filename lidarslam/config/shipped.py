"""The configurations and benchmarks that come with the program, by name."""

from importlib.resources import files
from pathlib import Path

CONFIGS = Path(str(files("lidarslam"))) / "configs"
BENCHMARKS = CONFIGS / "benchmarks"


def shipped_files(folder: Path) -> dict[str, Path]:
    """The YAML files of a folder by their names, without the suffix."""
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def headline(path: Path) -> str:
    """The first line of a file, a comment that describes it."""
    with path.open(encoding="utf-8") as lines:
        return next(lines).removeprefix("#").strip()
