"""What is shown in Rerun: finished runs, the raw scans of a recording, errors of a map."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.evaluation.map.metrics import MapComparison
from lidarslam.evaluation.report.drawing import error_colours, viridis
from lidarslam.evaluation.trajectory.alignment import align, common_instants
from lidarslam.evaluation.trajectory.metrics import absolute_errors
from lidarslam.storage.finished_run import FinishedRun
from lidarslam.viewer import rerun_recording as rec
from lidarslam.viewer.rerun_recording import BACKGROUND, Show
from lidarslam.viewer.view import levels

# The rest of Okabe and Ito's palette, without those of the reference and of lost scans.
_COLOURS = ((86, 180, 233), (230, 159, 0), (204, 121, 167), (240, 228, 66), (0, 114, 178))
_ERRORS = "errors"
_LIDAR = "world/lidar"
# Where the eye begins to follow the sensor, metres.
_BEHIND = (-40.0, 0.0, 25.0)


@dataclass(frozen=True, eq=False)
class _Shown:
    """A run in the world of the view."""

    run: FinishedRun
    name: str  # different from those of the others
    colour: tuple[int, int, int]
    # (M,) where there is a reference: distances to it, and their stamps
    errors_m: FloatArray = field(default_factory=lambda: np.empty(0))
    error_stamps: FloatArray = field(default_factory=lambda: np.empty(0))

    @property
    def entity(self) -> str:
        """Path of its entity."""
        return rr.new_entity_path(["world", self.name])


def show_runs(runs: Sequence[FinishedRun], reference: Trajectory | None, config: ViewerConfig) -> Show:
    """Trajectories in time, lost scans, loops, maps, and errors of one run or more.

    Runs that share instants with the reference, the true trajectory, are aligned with it; others are shown each in its
    own world, which begins at its first scan.
    """
    if reference is not None:
        reference = rec.about_its_start(reference, least=1)
    shown = list(_in_one_world(runs, reference))

    def log(recording: rr.RecordingStream) -> None:
        if reference is not None:
            recording.log("world/ground truth", rec.true_path(reference), static=True)
        for one in shown:
            _log_run(recording, one, len(shown) > 1, config)

    return Show(" ".join(one.name for one in shown), _layout_of_runs(shown), log)


def _in_one_world(runs: Sequence[FinishedRun], reference: Trajectory | None) -> Iterator[_Shown]:
    names = [run.name for run in runs]
    for number, run in enumerate(runs):
        name = run.name if names.count(run.name) == 1 else f"{run.name} ({number + 1})"
        shown = _Shown(run, name, _COLOURS[number % len(_COLOURS)])
        base = next((other for other in runs if other.path is not None and other.path == run.frame_of), None)
        if reference is None:
            yield shown
        elif base is not None:  # it is moved with the run in whose map it was localised
            found = common_instants(base.trajectory, reference)
            yield shown if found is None else _moved(shown, align(found.estimate, found.reference))
        else:
            yield _aligned(shown, reference)


def _moved(shown: _Shown, T_reference_world: FloatArray) -> _Shown:
    run = shown.run
    trajectory = run.trajectory.transformed(T_reference_world)
    points = transform_points(T_reference_world, run.map_points)
    return replace(shown, run=replace(run, trajectory=trajectory, map_points=points))


def _aligned(shown: _Shown, reference: Trajectory) -> _Shown:
    """With its errors; unchanged where it shares no instants with the reference."""
    association = common_instants(shown.run.trajectory, reference)
    if association is None:
        return shown
    T_reference_world = align(association.estimate, association.reference)
    errors_m, _ = absolute_errors(association, T_reference_world)
    moved = _moved(shown, T_reference_world)
    return replace(moved, error_stamps=association.estimate.stamps, errors_m=errors_m)


def _log_run(recording: rr.RecordingStream, shown: _Shown, several: bool, config: ViewerConfig) -> None:
    run, colour, entity = shown.run, shown.colour, shown.entity
    positions, stamps = run.trajectory.positions, run.trajectory.stamps

    def log(name: str, style: rr.AsComponents, stamps: FloatArray, columns: rr.ComponentColumnList) -> None:
        if len(stamps):
            recording.log(f"{entity}/{name}", style, static=True)
            recording.send_columns(f"{entity}/{name}", [rec.stamp_column(stamps)], columns)

    line = rr.LineStrips3D.from_fields(colors=[colour], radii=[rec.PATH_RADIUS])
    pieces = np.stack([positions[:-1], positions[1:]], axis=1)
    log("trajectory", line, stamps[1:], rr.LineStrips3D.columns(strips=[[piece] for piece in pieces]))
    loops = rr.LineStrips3D.columns(strips=[[loop] for loop in positions[run.loops]])
    log("loops", line, stamps[run.loops.max(axis=1, initial=0)], loops)
    place = rr.Points3D.from_fields(colors=[colour], radii=[2.5 * rec.PATH_RADIUS], labels=[shown.name])
    log("lidar", place, stamps, rr.Points3D.columns(positions=positions))
    lost = rr.Points3D.from_fields(colors=[rec.STATUS_COLOURS[Status.LOST]], radii=[2.0 * rec.PATH_RADIUS])
    log("lost", lost, stamps[run.lost], rr.Points3D.columns(positions=positions[run.lost]))
    rec.log_map(recording, f"{entity}/map", run.map_points, config.map_points, colour if several else None, static=True)
    if len(shown.errors_m):
        series = rr.new_entity_path([_ERRORS, shown.name])
        recording.log(series, rr.SeriesLines(names=shown.name, colors=[colour]), static=True)
        values = rr.Scalars.columns(scalars=shown.errors_m)
        recording.send_columns(series, [rec.stamp_column(shown.error_stamps)], values)


def _layout_of_runs(shown: Sequence[_Shown]) -> rrb.Blueprint:
    """One space for all, with the map of the first; the eye icon next to an entity's name shows and hides it."""
    overrides: dict[rr.encodings.EntityPath | str, rrb.VisibleTimeRanges | rrb.EntityBehavior] = {}
    for number, one in enumerate(shown):
        for name in ("trajectory", "loops", "lost"):
            overrides[f"{one.entity}/{name}"] = rrb.VisibleTimeRanges(rec.whole_past())
        overrides[f"{one.entity}/map"] = rrb.EntityBehavior(visible=number == 0)
    space = rrb.Spatial3DView(origin="/world", name="Trajectories and maps", background=BACKGROUND, overrides=overrides)
    views: list[rrb.View] = [space]
    if any(len(one.errors_m) for one in shown):
        views.append(rrb.TimeSeriesView(origin=f"/{_ERRORS}", name="Distance to the ground truth [m]"))
    return rrb.Blueprint(
        rrb.Vertical(*views, row_shares=[4, 1][: len(views)]),
        rrb.TimePanel(timeline=rec.TIME, play_state="following", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
    )


def show_scans(
    recording: Recording,
    source: Path,
    chosen: range,
    config: ViewerConfig,
    bar: Callable[[str], AbstractContextManager[Callable[[int, int], None]]],
    tell: Callable[[str], None],
) -> Show:
    """Scans about the sensor, by intensity or else by height; where there is a true path, the scans on it too.

    The scans are read while they are logged; `bar` makes a progress bar of a name, to be called with the number of
    scans done, and the total, and `tell` is called with each fault of the recording, as a line.
    """
    truth = recording.ground_truth
    if truth is not None:
        truth = rec.about_its_start(truth, least=2)

    def log(stream: rr.RecordingStream) -> None:
        if truth is not None:
            path = rr.LineStrips3D([truth.positions], colors=[rec.REFERENCE_COLOUR], radii=rec.PATH_RADIUS)
            stream.log("world/ground truth", path, static=True)
            # The eye follows only drawn entities.
            place = rr.Points3D([[0.0, 0.0, 0.0]], colors=[rec.REFERENCE_COLOUR], radii=2.0 * rec.PATH_RADIUS)
            stream.log(_LIDAR, place, static=True)
        faults, done = Faults(), 0
        with bar(source.name) as count:
            for done, scan in enumerate(take_in(recording, chosen, faults), start=1):
                _log_scan(stream, done - 1, scan, truth, config.scan_points)
                count(done, len(chosen))
        for warning in (*recording.warnings, *faults.warnings()):
            tell(warning)
        if not done:
            raise InputError(f"{source}: no scan can be read")

    return Show(source.name, _layout_of_scans(truth is not None), log)


def _log_scan(recording: rr.RecordingStream, index: int, scan: Scan, truth: Trajectory | None, points: int) -> None:
    rec.set_stamp(recording, index, scan.stamp)
    if truth is not None:  # beyond its ends its first or last pose
        stamp = np.clip(scan.stamp, truth.stamps[0], truth.stamps[-1])
        T_world_lidar = truth.at(np.array([stamp]))[0]
        recording.log(_LIDAR, rr.Transform3D(translation=T_world_lidar[:3, 3], mat3x3=T_world_lidar[:3, :3]))
    shown = rec.every_nth(scan.points, points)
    values = shown[:, 2]
    if scan.intensities is not None:  # the darkest where there is none
        values = np.nan_to_num(rec.every_nth(scan.intensities, points).astype(np.float64))
    recording.log(f"{_LIDAR}/scan", rr.Points3D(shown, colors=viridis(levels(values)), radii=rec.SCAN_RADIUS))


def _layout_of_scans(has_truth: bool) -> rrb.Blueprint:
    scan = rrb.Spatial3DView(origin=f"/{_LIDAR}", name="Scan", background=BACKGROUND)
    views = [scan]
    if has_truth:
        eye = rrb.EyeControls3D(position=_BEHIND, look_target=(0.0, 0.0, 0.0), tracking_entity=f"/{_LIDAR}")
        on_path = rrb.Spatial3DView(origin="/world", name="On the true path", background=BACKGROUND, eye_controls=eye)
        views.append(on_path)
    panel = rrb.TimePanel(timeline=rec.TIME, play_state="playing", loop_mode="all", state="collapsed")
    return rrb.Blueprint(rrb.Horizontal(*views), panel, collapse_panels=True)


def show_errors(comparison: MapComparison, positions: FloatArray, clip_m: float) -> Show:
    """A map coloured by its distance to the reference, and the reference by that to the map.

    The clouds are shown about their middle, because the viewer counts in single precision, with the path (K, 3) of the
    sensor in the reference's frame; `clip_m` is the distance of the brightest colour.
    """
    points = comparison.reference_errors.points
    middle = np.round(points.mean(axis=0)) if len(points) else np.zeros(3)
    clouds = {
        "map_to_reference": (comparison.map_errors, "Map: distance to the reference"),
        "reference_to_map": (comparison.reference_errors, "Reference: distance to the map"),
    }

    def log(recording: rr.RecordingStream) -> None:
        for entity, (errors, _) in clouds.items():
            colours = error_colours(errors.distances_m, clip_m)
            cloud = rr.Points3D(errors.points - middle, colors=colours, radii=rec.MAP_RADIUS)
            recording.log(f"world/{entity}", cloud, static=True)
        line = rr.LineStrips3D([positions - middle], colors=[rec.REFERENCE_COLOUR], radii=rec.PATH_RADIUS)
        recording.log("world/path", line, static=True)
        origin = ", ".join(f"{m:.0f}" for m in middle)
        text = f"dark: 0 m, bright: {clip_m:g} m and more; the origin is at {origin}"
        recording.log("legend", rr.TextDocument(text), static=True)

    views = [
        rrb.Spatial3DView(
            origin="/world", name=title, contents=["/world/path", f"/world/{entity}"], background=BACKGROUND
        )
        for entity, (_, title) in clouds.items()
    ]
    legend = rrb.TextDocumentView(origin="/legend", name="Colours")
    layout = rrb.Vertical(rrb.Horizontal(*views), legend, row_shares=[8, 1])
    return Show("map errors", rrb.Blueprint(layout, collapse_panels=True), log)
