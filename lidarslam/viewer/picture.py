"""Maps and trajectories as pictures, drawn without a window or a graphics card, and as videos of one turn."""

import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import make_directory, written
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.evaluation.report.drawing import DISTANCE_FIELD, beyond_m, leaves, paths_in_bulk
from lidarslam.evaluation.trajectory.alignment import align, common_instants
from lidarslam.evaluation.trajectory.metrics import absolute_errors
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.storage.directory import MAP_PLY, TRAJECTORY_TUM
from lidarslam.storage.finished_run import read_scans, read_trajectory, run_directories, shown_map
from lidarslam.viewer import view as drawing
from lidarslam.viewer.view import Colour, ColourScale, Entry, Quantity, View

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
    errors_m: FloatArray | None = None  # (N,) distances of the positions to the reference, NaN where it has none
    distances_m: FloatArray | None = None  # of the cloud's points to a reference map

    def point_values(self, quantity: Quantity) -> FloatArray | None:
        """The values that colour the points of the cloud; None where they have none."""
        intensity = self.cloud.attributes.intensity
        values = {
            "height": self.cloud.points[:, 2],
            "intensity": None if intensity is None else intensity.astype(np.float64),
            "error": self.distances_m,
        }
        return values.get(quantity)

    def pose_values(self, quantity: Quantity) -> FloatArray | None:
        """The values that colour the path; None for its status."""
        return self.errors_m if quantity == "error" and self.distances_m is None else None


@dataclass(frozen=True, eq=False)
class Frame:
    """The common properties of pictures that are compared."""

    view: View
    quantity: Quantity  # that a single run is coloured by
    scale: ColourScale | None  # of its colours; None without values


def fit_frame(
    runs: Sequence[DrawnRun],
    elevation_deg: float = TOP,
    reference: FloatArray | None = None,
    width: int = drawing.WIDTH,
    quantity: Quantity = "height",
    turn_deg: float | None = None,
) -> Frame:
    """The frame of an orthographic picture, from an elevation above the horizon, that holds all but diverging runs."""
    found = [values for run in runs for values in (run.point_values(quantity), run.pose_values(quantity))]
    scale = drawing.fit_scale(
        quantity, np.concatenate([np.empty(0), *(values for values in found if values is not None)])
    )
    return Frame(drawing.fit_view(*framed(runs, reference), elevation_deg, turn_deg, width), quantity, scale)


def framed(runs: Sequence[DrawnRun], reference: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """The points (N, 3) and positions (M, 3) that a picture has to hold: not those of diverging runs."""
    moved = [run for run in runs if len(run.positions)]
    kept = dict(zip(map(id, moved), paths_in_bulk([run.positions for run in moved], reference), strict=True))
    shown = [run for run in runs if kept.get(id(run), True)]
    positions = [run.positions for run in shown] + ([] if reference is None else [reference])
    return np.concatenate([run.cloud.points for run in shown or runs]), np.concatenate(positions)


def draw_runs(runs: Sequence[DrawnRun], frame: Frame, reference: FloatArray | None = None) -> NDArray[np.uint8]:
    """Maps and trajectories (height, width, 3); below the view's height, the legend, the size and the scale bar.

    One run is coloured by the frame's quantity, and its path by status. Several have a colour each; where maps cover
    each other, their colours mix. Their paths are the narrower the later in order; a true trajectory (K, 3) is below.
    """
    fine = frame.view.enlarged(_SUPERSAMPLING)
    # A single run is coloured by its quantity.
    colours = [_RUN_COLOURS[n % len(_RUN_COLOURS)] if len(runs) > 1 else None for n in range(len(runs))]
    image = Image.fromarray(_draw_maps(runs, colours, fine, frame))
    if reference is not None:
        drawing.draw_path(image, fine, reference, [_REFERENCE] * len(reference), _REFERENCE_WIDER)
    widths = [1.0 + _WIDENING * below for below in reversed(range(len(runs)))]
    around = _outline(runs, frame)
    if around == drawing.INK:  # the path is to be read by its colour
        widths = [_REFERENCE_WIDER]
    if around is not None:
        for run, wider in zip(runs, widths, strict=True):
            drawing.draw_path(image, fine, run.positions, [around] * len(run.positions), wider + 1.0)
    for run, colour, wider in zip(runs, colours, widths, strict=True):
        drawing.draw_path(image, fine, run.positions, _path_colours(run, colour, frame), wider)
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
    runs: Sequence[DrawnRun], colours: Sequence[Colour | None], view: View, frame: Frame
) -> NDArray[np.uint8]:
    """All maps (height, width, 3) on paper; the mean of their colours where several cover a pixel."""
    total = np.zeros((view.height * view.width, 3), dtype=np.uint16)
    count = np.zeros(len(total), dtype=np.uint16)
    for run, colour in zip(runs, colours, strict=True):
        if len(run.cloud):
            layer = drawing.draw_layer(run.cloud.points, run.cloud.normals, view)
            surface = _point_colours(run, frame)[layer.points] if colour is None else _tint(colour)
            total[layer.pixels] += (surface * layer.brightness[:, None]).astype(np.uint16)
            count[layer.pixels] += 1
    picture = np.full(total.shape, drawing.PAPER, dtype=np.uint8)
    drawn = np.flatnonzero(count)
    picture[drawn] = total[drawn] // count[drawn, None]
    return picture.reshape(view.height, view.width, 3)


def _point_colours(run: DrawnRun, frame: Frame) -> NDArray[np.uint8]:
    values, rgb = run.point_values(frame.quantity), run.cloud.attributes.rgb
    if frame.quantity == "rgb" and rgb is not None:
        return rgb
    if frame.scale is None or values is None:
        return np.tile(np.array(drawing.UNKNOWN, dtype=np.uint8), (len(run.cloud), 1))
    return frame.scale.colours(values)


def _tint(colour: Colour) -> NDArray[np.float32]:
    return np.float32(_MAP_TINT) * np.array(colour, dtype=np.float32) + np.float32(255.0 * (1.0 - _MAP_TINT))


def _path_colours(run: DrawnRun, colour: Colour | None, frame: Frame) -> list[Colour]:
    values = run.pose_values(frame.quantity) if colour is None else None
    if values is not None and frame.scale is not None:
        return [(red, green, blue) for red, green, blue in frame.scale.colours(values).tolist()]
    statuses = run.statuses or [Status.OK] * len(run.positions)
    usual = _PATH_COLOURS | ({} if colour is None else {Status.OK: colour, Status.DEGRADED: colour})
    return [usual[status] for status in statuses]


def _outline(runs: Sequence[DrawnRun], frame: Frame) -> Colour | None:
    """The colour around paths: dark where these are pale, white on maps, none on paper."""
    if len(runs) == 1 and runs[0].pose_values(frame.quantity) is not None:
        return drawing.INK
    return drawing.HALO if any(len(run.cloud) for run in runs) else None


def _entries(
    runs: Sequence[DrawnRun],
    colours: Sequence[Colour | None],
    widths: Sequence[float],
    frame: Frame,
    with_reference: bool,
) -> Iterator[Entry]:
    """The legend, the size of the frame, the scale bar, and the runs that leave the picture."""
    view = frame.view
    single = runs[0] if len(runs) == 1 else None
    by_status = single is None or single.pose_values(frame.quantity) is None
    for run, colour, wider in zip(runs, colours, widths, strict=True):
        length_m = float(np.linalg.norm(np.diff(run.positions, axis=0), axis=1).sum())
        if len(run.positions) or colour is not None:
            text = f"{_named(run, runs)}, {length_m:.0f} m" if len(run.positions) else run.name
            line = colour or _PATH_COLOURS[Status.OK]
            yield drawing.line_entry(text, line, view.width, wider) if by_status else Entry(text)
    found = {status for run in runs for status in run.statuses} if by_status else set()
    shown = (Status.LOST,) if single is None else (Status.DEGRADED, Status.LOST)
    yield from (drawing.line_entry(s.value, _PATH_COLOURS[s], view.width) for s in shown if s in found)
    if with_reference:
        yield drawing.line_entry("ground truth", _REFERENCE, view.width)
    if any(len(run.positions) for run in runs):
        yield drawing.end_entry("start", drawing.START, view.width)
        yield drawing.end_entry("end", drawing.INK, view.width)
    if single is not None and frame.scale is not None and (len(single.cloud) or not by_status):
        ramp = frame.scale.ramp[np.linspace(0, 255, round(_RAMP_LENGTH * view.width)).astype(np.intp)]
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


def load_drawn_runs(paths: Sequence[Path], truth: Trajectory | None = None) -> list[DrawnRun]:
    """Runs, the runs of a comparison, and .ply or .pcd files; the truth of the recording gives the runs' errors."""
    return [_load(path, truth) for given in paths for path in run_directories(given)]


def require_quantity(run: DrawnRun, quantity: Quantity) -> None:
    """Refuse to colour a run by a quantity that it lacks."""
    known = run.cloud.attributes.rgb if quantity == "rgb" else run.point_values(quantity)
    if known is None:
        known = run.pose_values(quantity)
    if known is None or not np.isfinite(known).any():
        found = "a file of `evaluate --errors`, or the recording's ground truth" if quantity == "error" else "its map"
        raise InputError(f"{run.name}: cannot be coloured by {quantity}: there is none in {found}")


def _load(path: Path, truth: Trajectory | None) -> DrawnRun:
    name, cloud = path.resolve().name, shown_map(path)
    has_trajectory = (path / TRAJECTORY_TUM).is_file()
    if path.is_file() or ((path / MAP_PLY).is_file() and not has_trajectory):
        if not len(cloud):
            raise InputError(f"{path}: holds no map to draw")
        return DrawnRun(name, cloud, distances_m=_distances_m(path, len(cloud)))
    trajectory = read_trajectory(path)
    errors_m = None if truth is None else _errors_m(trajectory, truth)
    return DrawnRun(name, cloud, trajectory.positions, read_scans(path, len(trajectory)).statuses, errors_m)


def _errors_m(trajectory: Trajectory, truth: Trajectory) -> FloatArray | None:
    """Distances (N,) of the poses to the truth, aligned as for the ATE; None where they share no instants."""
    association = common_instants(trajectory, truth)
    if association is None:
        return None
    errors_m = np.full(len(trajectory), np.nan)
    errors_m[association.rows] = absolute_errors(association, align(association.estimate, association.reference))[0]
    return errors_m


def _distances_m(path: Path, points: int) -> FloatArray | None:
    """The distances to a reference map in a file of `evaluate --errors`; None in any other."""
    if path.suffix.lower() != ".ply":
        return None
    table = read_ply(path)
    found = DISTANCE_FIELD in (table.dtype.names or ()) and len(table) == points
    return table[DISTANCE_FIELD].astype(np.float64) if found else None


_FRAMES = 72
_PER_SECOND = 12
# Keeps a GIF file to a few megabytes.
_WIDTH, _GIF_COLOURS = 640, 64
_VIDEO_SUFFIXES = (".gif", ".mp4")


def check_video_file(path: Path) -> None:
    """Refuse a file that cannot be written later."""
    if path.suffix.lower() not in _VIDEO_SUFFIXES:
        raise OutputError(f"{path}: a video must end in .gif or .mp4")
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise OutputError(f"{path}: .mp4 is written by ffmpeg, which is not on PATH; install it, or name a .gif file")


def turn_runs(
    runs: Sequence[DrawnRun], quantity: Quantity, count: Callable[[int, int], None]
) -> Iterator[NDArray[np.uint8]]:
    """Frames (height, width, 3) of one turn of runs in one world, all of one size and scale.

    `count` is called with the number of each drawn frame, from 1, and their total.
    """
    frame = fit_frame(runs, OBLIQUE, width=_WIDTH, quantity=quantity)
    turns_deg = frame.view.turn_deg + np.linspace(0.0, 360.0, _FRAMES, endpoint=False)
    for number, view in enumerate(drawing.turning_views(*framed(runs), OBLIQUE, turns_deg.tolist(), _WIDTH), start=1):
        yield draw_runs(runs, replace(frame, view=view))
        count(number, _FRAMES)


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
