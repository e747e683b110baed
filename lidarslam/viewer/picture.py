"""Maps and trajectories as pictures, drawn without a window or a graphics card."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import make_directory, written
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.evaluation.report.drawing import beyond_m, leaves, paths_in_bulk
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.storage.directory import MAP_PLY, TRAJECTORY_TUM
from lidarslam.storage.finished_run import read_scans, read_trajectory, run_directories, shown_map
from lidarslam.viewer import view as drawing
from lidarslam.viewer.view import Colour, Entry, HeightScale, View

TOP, OBLIQUE = 90.0, 35.0
# Factor of the pixels along each side that are drawn and then averaged.
_SUPERSAMPLING = 2
_SUFFIXES = (".png", ".jpg", ".jpeg")
_PATH_COLOURS: dict[Status, Colour] = {
    Status.OK: (15, 15, 15),
    Status.DEGRADED: (255, 140, 0),
    Status.LOST: (225, 0, 60),
}
# After Okabe and Ito (blue, vermilion, green, purple, orange, sky blue), then two more.
_RUN_COLOURS: tuple[Colour, ...] = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (120, 40, 90),
    (110, 80, 50),
)  # fmt: skip
# Of several paths each is this much wider than the next, which is drawn above it: both are seen where they coincide.
_WIDENING = 0.8
_REFERENCE: Colour = (150, 150, 150)
_REFERENCE_WIDER = 2.0
_MAP_TINT = 0.55  # the share of a run's colour in that of its map; the rest is white
_RAMP_LENGTH = 0.08


@dataclass(frozen=True, eq=False)
class DrawnRun:
    """The drawn parts of a run; of a cloud alone, no trajectory."""

    name: str
    cloud: PointCloud
    positions: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) of the trajectory
    statuses: Sequence[Status] = ()  # of the N scans; none: all ok


@dataclass(frozen=True, eq=False)
class Frame:
    """The common properties of pictures that are compared."""

    view: View
    scale: HeightScale | None  # of the colours of a single run; None without a map


def fit_frame(
    runs: Sequence[DrawnRun],
    elevation_deg: float = TOP,
    reference: FloatArray | None = None,
    width: int = drawing.WIDTH,
    turn_deg: float | None = None,
) -> Frame:
    """The frame of an orthographic picture, from an elevation above the horizon, that holds all but diverging runs."""
    moved = [run for run in runs if len(run.positions)]
    kept = dict(zip(map(id, moved), paths_in_bulk([run.positions for run in moved], reference), strict=True))
    shown = [run for run in runs if kept.get(id(run), True)]
    positions = [run.positions for run in shown] + ([] if reference is None else [reference])
    points = np.concatenate([run.cloud.points for run in shown or runs])
    view = drawing.fit_view(points, np.concatenate(positions), elevation_deg, turn_deg, width)
    return Frame(view, drawing.fit_scale(np.concatenate([run.cloud.points[:, 2] for run in runs])))


def draw_runs(runs: Sequence[DrawnRun], frame: Frame, reference: FloatArray | None = None) -> NDArray[np.uint8]:
    """Maps and trajectories (height, width, 3); below the view's height, the legend, the size and the scale bar.

    One run is coloured by height, and its path by status. Several have a colour each; where maps cover each other,
    their colours mix. Their paths are the narrower the later in order; a true trajectory (K, 3) is below.
    """
    fine = frame.view.enlarged(_SUPERSAMPLING)
    colours = [_RUN_COLOURS[n % len(_RUN_COLOURS)] if len(runs) > 1 else None for n in range(len(runs))]
    image = Image.fromarray(_draw_maps(runs, colours, fine, frame.scale))
    if reference is not None:
        drawing.draw_path(image, fine, reference, [_REFERENCE] * len(reference), _REFERENCE_WIDER)
    widths = [1.0 + _WIDENING * below for below in reversed(range(len(runs)))]
    if any(len(run.cloud) for run in runs):  # white around the paths, where they lie on maps
        for run, wider in zip(runs, widths, strict=True):
            drawing.draw_path(image, fine, run.positions, [drawing.HALO] * len(run.positions), wider + 1.0)
    for run, colour, wider in zip(runs, colours, widths, strict=True):
        drawing.draw_path(image, fine, run.positions, _path_colours(run, colour), wider)
    for run, colour, wider in zip(runs, colours, widths, strict=True):
        drawing.draw_end(image, fine, run.positions[-1:], colour or drawing.INK, wider)
    for run in runs:
        drawing.draw_end(image, fine, run.positions[:1], drawing.START)
    entries = list(_entries(runs, colours, widths, frame, reference is not None))
    return np.asarray(drawing.with_strip(image.reduce(_SUPERSAMPLING), entries))


def draw_apart(runs: Sequence[DrawnRun], folder: Path, frame: Frame) -> list[Path]:
    """A picture of each run, FOLDER/NAME.png, all in one frame; the files."""
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        raise InputError(f"{folder}: several runs have one name ({', '.join(names)}); draw them in one picture")
    make_directory(folder)
    files = [folder / f"{name}.png" for name in names]
    for run, file in zip(runs, files, strict=True):
        save_picture(file, draw_runs([run], frame))
    return files


def save_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture (height, width, 3) as .png, .jpg or .jpeg."""
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: a picture must end in .png or .jpg")
    with written(path) as partial:
        Image.fromarray(picture).save(partial)


def _draw_maps(
    runs: Sequence[DrawnRun], colours: Sequence[Colour | None], view: View, scale: HeightScale | None
) -> NDArray[np.uint8]:
    """All maps (height, width, 3) on paper; the mean of their colours where several cover a pixel."""
    total = np.zeros((view.height * view.width, 3), dtype=np.uint16)
    count = np.zeros(len(total), dtype=np.uint16)
    for run, colour in zip(runs, colours, strict=True):
        if len(run.cloud) and scale is not None:
            layer = drawing.draw_layer(run.cloud.points, run.cloud.normals, view)
            surface = scale.colours(run.cloud.points[layer.points, 2]) if colour is None else _tint(colour)
            total[layer.pixels] += (surface * layer.brightness[:, None]).astype(np.uint16)
            count[layer.pixels] += 1
    picture = np.full(total.shape, drawing.PAPER, dtype=np.uint8)
    drawn = np.flatnonzero(count)
    picture[drawn] = total[drawn] // count[drawn, None]
    return picture.reshape(view.height, view.width, 3)


def _tint(colour: Colour) -> NDArray[np.float32]:
    return np.float32(_MAP_TINT) * np.array(colour, dtype=np.float32) + np.float32(255.0 * (1.0 - _MAP_TINT))


def _path_colours(run: DrawnRun, colour: Colour | None) -> list[Colour]:
    statuses = run.statuses or [Status.OK] * len(run.positions)
    usual = _PATH_COLOURS | ({} if colour is None else {Status.OK: colour, Status.DEGRADED: colour})
    return [usual[status] for status in statuses]


def _entries(
    runs: Sequence[DrawnRun],
    colours: Sequence[Colour | None],
    widths: Sequence[float],
    frame: Frame,
    with_reference: bool,
) -> Iterator[Entry]:
    """The legend, the size of the frame, the scale bar, and the runs that leave the picture."""
    view, is_single = frame.view, len(runs) == 1
    for run, colour, wider in zip(runs, colours, widths, strict=True):
        length_m = float(np.linalg.norm(np.diff(run.positions, axis=0), axis=1).sum())
        if len(run.positions) or colour is not None:
            text = f"{_named(run, runs)}, {length_m:.0f} m" if len(run.positions) else run.name
            yield drawing.line_entry(text, colour or _PATH_COLOURS[Status.OK], view.width, wider)
    found = {status for run in runs for status in run.statuses}
    shown = (Status.DEGRADED, Status.LOST) if is_single else (Status.LOST,)
    yield from (drawing.line_entry(s.value, _PATH_COLOURS[s], view.width) for s in shown if s in found)
    if with_reference:
        yield drawing.line_entry("ground truth", _REFERENCE, view.width)
    if any(len(run.positions) for run in runs):
        yield drawing.end_entry("start", drawing.START, view.width)
        yield drawing.end_entry("end", drawing.INK, view.width)
    if is_single and frame.scale is not None and len(runs[0].cloud):
        ramp = drawing.HEIGHT_COLOURS[np.linspace(0, 255, round(_RAMP_LENGTH * view.width)).astype(np.intp)]
        yield drawing.ramp_entry(*frame.scale.ends, ramp, view.width)
    across, up = view.size_m
    yield drawing.scale_entry(view)
    yield Entry(f"{across:.0f} m x {up:.0f} m" if view.axes[2, 2] == 1.0 else f"{across:.0f} m wide")
    half = 0.5 * view.pixel_m * np.array([view.width, view.height])
    for run in runs:
        outside_m = beyond_m(run.positions @ view.axes[:2].T - view.centre, -half, half)
        if outside_m > 0.0:
            yield Entry(f"{leaves(drawing.short(_named(run, runs)), {' m': outside_m})} outside")


def _named(run: DrawnRun, runs: Sequence[DrawnRun]) -> str:
    return "path" if len(runs) == 1 else run.name


def load_drawn_runs(paths: Sequence[Path]) -> list[DrawnRun]:
    """Runs, the runs of a comparison, and .ply or .pcd files."""
    return [_load(path) for given in paths for path in run_directories(given)]


def _load(path: Path) -> DrawnRun:
    name, cloud = path.resolve().name, shown_map(path)
    has_trajectory = (path / TRAJECTORY_TUM).is_file()
    if path.is_file() or ((path / MAP_PLY).is_file() and not has_trajectory):
        if not len(cloud):
            raise InputError(f"{path}: holds no map to draw")
        return DrawnRun(name, cloud)
    trajectory = read_trajectory(path)
    return DrawnRun(name, cloud, trajectory.positions, read_scans(path, len(trajectory)).statuses)
