"""Maps and trajectories of runs as a picture, drawn without a window or a graphics card."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lidarslam.core.errors import OutputError
from lidarslam.core.files import cannot_write, replacing
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.evaluation.report.error_colours import viridis
from lidarslam.mapping.global_map.global_map import PointCloud
from lidarslam.viewer.drawing import annotations as notes
from lidarslam.viewer.drawing.annotations import Colour, Entry
from lidarslam.viewer.drawing.shading import draw_layer
from lidarslam.viewer.drawing.view import WIDTH, View, fit_view

TOP, OBLIQUE = 90.0, 35.0
# Drawn on so many times more pixels along each side, and averaged.
_SUPERSAMPLING = 2
_SUFFIXES = (".png", ".jpg", ".jpeg")
_PATH_COLOURS: dict[Status, Colour] = {
    Status.OK: (15, 15, 15),
    Status.DEGRADED: (255, 140, 0),
    Status.LOST: (225, 0, 60),
}
# After Okabe and Ito (blue, vermilion, green, purple, orange, sky blue).
_RUN_COLOURS: tuple[Colour, ...] = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233),
)  # fmt: skip
_REFERENCE: Colour = (150, 150, 150)
_MAP_TINT = 0.55  # the share of a run's colour in that of its map; the rest is white
_RAMP_LENGTH = 0.08
# Colours of heights on white paper: light ground, dark tops; (256, 3).
_STOPS = np.array([[201, 209, 214], [140, 181, 199], [66, 138, 166], [41, 84, 135], [60, 28, 92]])
_RAMP = np.stack([np.interp(np.linspace(0.0, 4.0, 256), range(5), stop) for stop in _STOPS.T], axis=1).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class DrawnRun:
    """What is drawn of a run; of a cloud alone, no trajectory."""

    name: str
    cloud: PointCloud
    positions: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) of the trajectory
    statuses: Sequence[Status] = ()  # of the N scans; none: all ok


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture, and the view that its upper part shows."""

    pixels: NDArray[np.uint8]  # (height, width, 3); below the view's height, the legend
    view: View


def draw_runs(
    runs: Sequence[DrawnRun], elevation_deg: float = TOP, reference: FloatArray | None = None, width: int = WIDTH
) -> Picture:
    """Maps and trajectories in one frame, with legend, size and scale bar.

    One run is coloured by height, and its path by status. Several have a colour each; where maps cover each other,
    their colours mix.

    Args:
        runs: in one world.
        elevation_deg: of the camera above the horizon; the projection is orthographic.
        reference: positions (K, 3) of a true trajectory, drawn below the others.
        width: of the picture, pixels.
    """
    points = np.concatenate([run.cloud.points for run in runs])
    paths = [run.positions for run in runs] + ([] if reference is None else [reference])
    view = fit_view(points, np.concatenate(paths), elevation_deg, width=width)
    fine = view.enlarged(_SUPERSAMPLING)
    colours = _colours(runs)
    image = Image.fromarray(_draw_maps(runs, colours, fine))
    if reference is not None:
        notes.draw_path(image, fine, reference, [_REFERENCE] * len(reference), around=_REFERENCE)
    halo = notes.HALO if len(points) else None
    for run, colour in zip(runs, colours, strict=True):
        notes.draw_path(image, fine, run.positions, _path_colours(run, colour), halo)
    for run, colour in zip(runs, colours, strict=True):
        notes.draw_ends(image, fine, run.positions, colour or notes.INK)
    image = notes.with_strip(image.reduce(_SUPERSAMPLING), list(_entries(runs, colours, view, reference is not None)))
    return Picture(np.asarray(image), view)


def save_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture (height, width, 3) as .png, .jpg or .jpeg.

    Raises:
        OutputError: it cannot be written.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: a picture must end in .png or .jpg")
    try:
        with replacing(path) as partial:
            Image.fromarray(picture).save(partial)
    except OSError as error:
        raise cannot_write(path, error) from error


def height_colours(points: FloatArray) -> NDArray[np.uint8]:
    """Colours (N, 3) by the height of points (N, 3), the lowest and highest 2 % clipped."""
    if not len(points):
        return np.empty((0, 3), dtype=np.uint8)
    low, high = _heights(points)
    return viridis(np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0))


def _heights(points: FloatArray) -> tuple[float, float]:
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    return float(low), float(high)


def _paper_colours(points: FloatArray) -> NDArray[np.uint8]:
    """Colours (N, 3) by height, as `height_colours`, from light ground to dark tops."""
    low, high = _heights(points)
    level = np.clip((points[:, 2] - low) * (255.0 / max(high - low, 1e-6)), 0.0, 255.0)
    return _RAMP[level.astype(np.uint8)]


def _colours(runs: Sequence[DrawnRun]) -> list[Colour | None]:
    """The colour of each of several runs; None for a single one."""
    if len(runs) == 1:
        return [None]
    return [_RUN_COLOURS[number % len(_RUN_COLOURS)] for number in range(len(runs))]


def _draw_maps(runs: Sequence[DrawnRun], colours: Sequence[Colour | None], view: View) -> NDArray[np.uint8]:
    """All maps (height, width, 3) on paper; the mean of their colours where several cover a pixel."""
    total = np.zeros((view.height * view.width, 3), dtype=np.uint16)
    count = np.zeros(len(total), dtype=np.uint16)
    for run, colour in zip(runs, colours, strict=True):
        if len(run.cloud):
            layer = draw_layer(run.cloud.points, run.cloud.normals, view)
            surface = _paper_colours(run.cloud.points)[layer.points] if colour is None else _tint(colour)
            total[layer.pixels] += (surface * layer.brightness[:, None]).astype(np.uint16)
            count[layer.pixels] += 1
    picture = np.full(total.shape, notes.PAPER, dtype=np.uint8)
    drawn = np.flatnonzero(count)
    picture[drawn] = total[drawn] // count[drawn, None]
    return picture.reshape(view.height, view.width, 3)


def _tint(colour: Colour) -> NDArray[np.float32]:
    """The colour of a run's map."""
    return np.float32(_MAP_TINT) * np.array(colour, dtype=np.float32) + np.float32(255.0 * (1.0 - _MAP_TINT))


def _path_colours(run: DrawnRun, colour: Colour | None) -> list[Colour]:
    statuses = run.statuses or [Status.OK] * len(run.positions)
    usual = _PATH_COLOURS | ({} if colour is None else {Status.OK: colour, Status.DEGRADED: colour})
    return [usual[status] for status in statuses]


def _entries(
    runs: Sequence[DrawnRun], colours: Sequence[Colour | None], view: View, with_reference: bool
) -> list[Entry]:
    """The legend, the size of the frame, and the scale bar."""
    entries = []
    for run, colour in zip(runs, colours, strict=True):
        length_m = float(np.linalg.norm(np.diff(run.positions, axis=0), axis=1).sum())
        named = "path" if colour is None else run.name
        if len(run.positions) or colour is not None:
            text = f"{named}, {length_m:.0f} m" if len(run.positions) else named
            entries.append(notes.line_entry(text, colour or _PATH_COLOURS[Status.OK], view.width))
    found = {status for run in runs for status in run.statuses}
    shown = (Status.DEGRADED, Status.LOST) if len(runs) == 1 else (Status.LOST,)
    entries += [notes.line_entry(s.value, _PATH_COLOURS[s], view.width) for s in shown if s in found]
    if with_reference:
        entries.append(notes.line_entry("ground truth", _REFERENCE, view.width))
    if any(len(run.positions) for run in runs):
        entries += [notes.end_entry("start", notes.START, view.width), notes.end_entry("end", notes.INK, view.width)]
    if len(runs) == 1 and len(runs[0].cloud):
        low, high = _heights(runs[0].cloud.points)
        ramp = _RAMP[np.linspace(0, 255, round(_RAMP_LENGTH * view.width)).astype(np.intp)]
        entries.append(notes.ramp_entry(f"z {low:.1f}", f"{high:.1f} m", ramp, view.width))
    across, up = view.size_m
    size = f"{across:.0f} m x {up:.0f} m" if view.axes[2, 2] == 1.0 else f"{across:.0f} m wide"
    return [*entries, notes.scale_entry(view), Entry(size)]
