"""The scene turning once about the vertical, as an animated GIF or, through ffmpeg, an MP4 file."""

import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lidarslam.core.errors import OutputError
from lidarslam.core.files import written
from lidarslam.viewer.annotations import Quantity
from lidarslam.viewer.picture import OBLIQUE, DrawnRun, draw_runs, fit_frame, framed
from lidarslam.viewer.view import turning_views

_FRAMES = 72
_PER_SECOND = 12
# Keeps a GIF file to a few megabytes.
_WIDTH, _GIF_COLOURS = 640, 64
_SUFFIXES = (".gif", ".mp4")


def check_video_file(path: Path) -> None:
    """Refuse a file that cannot be written later."""
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: a video must end in .gif or .mp4")
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise OutputError(f"{path}: .mp4 is written by ffmpeg, which is not on PATH; install it, or name a .gif file")


def turn_runs(
    runs: Sequence[DrawnRun],
    quantity: Quantity = "height",
    count: Callable[[int, int], None] = lambda *_: None,
    frames: int = _FRAMES,
) -> Iterator[NDArray[np.uint8]]:
    """Frames (height, width, 3) of one turn of runs in one world, all of one size and scale.

    `count` is called with the number of each drawn frame, from 1, and their total.
    """
    frame = fit_frame(runs, OBLIQUE, width=_WIDTH, quantity=quantity)
    turns_deg = frame.view.turn_deg + np.linspace(0.0, 360.0, frames, endpoint=False)
    for number, view in enumerate(turning_views(*framed(runs), OBLIQUE, turns_deg.tolist(), _WIDTH), start=1):
        yield draw_runs(runs, replace(frame, view=view))
        count(number, frames)


def save_video(path: Path, frames: Iterable[NDArray[np.uint8]]) -> None:
    """Write frames (height, width, 3) as .gif or .mp4."""
    check_video_file(path)
    with written(path) as partial:
        (_write_gif if path.suffix.lower() == ".gif" else _write_mp4)(partial, frames)


def _write_gif(path: Path, frames: Iterable[NDArray[np.uint8]]) -> None:
    images = map(Image.fromarray, frames)
    # One palette without dithering, so that static parts are the same in successive frames.
    first = next(images).quantize(_GIF_COLOURS, dither=Image.Dither.NONE)
    others = (image.quantize(palette=first, dither=Image.Dither.NONE) for image in images)
    duration_ms = 1000 // _PER_SECOND
    first.save(path, format="GIF", save_all=True, append_images=others, duration=duration_ms, loop=0)


def _write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]]) -> None:
    even = [frame[: len(frame) // 2 * 2, : frame.shape[1] // 2 * 2] for frame in frames]  # the codec wants even sides
    size, rate = f"{even[0].shape[1]}x{even[0].shape[0]}", str(_PER_SECOND)
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", rate, "-i", "-"]
    command = ["ffmpeg", "-loglevel", "error", "-y", *given, "-pix_fmt", "yuv420p", "-f", "mp4", str(path.resolve())]
    done = subprocess.run(command, input=b"".join(frame.tobytes() for frame in even), capture_output=True, check=False)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip()
        raise OutputError(f"ffmpeg ended with status {done.returncode}: {said}")
