"""Finished runs in Rerun, each with a colour and an entity of its own."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.alignment import align
from lidarslam.evaluation.trajectory.association import common_instants
from lidarslam.evaluation.trajectory.metrics import absolute_errors
from lidarslam.storage.finished_run import FinishedRun
from lidarslam.viewer.rerun_output import Show
from lidarslam.viewer.rerun_recording import (
    BACKGROUND,
    PATH_RADIUS,
    STATUS_COLOURS,
    TIME,
    about_its_start,
    log_map,
    stamp_column,
    true_path,
    whole_past,
)

# The rest of Okabe and Ito's palette, without those of the reference and of lost scans.
_COLOURS = ((86, 180, 233), (230, 159, 0), (204, 121, 167), (240, 228, 66), (0, 114, 178))
_ERRORS = "errors"


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
        reference = about_its_start(reference, least=1)
    shown = list(_in_one_world(runs, reference))

    def log(recording: rr.RecordingStream) -> None:
        if reference is not None:
            recording.log("world/ground truth", true_path(reference), static=True)
        for one in shown:
            _log_run(recording, one, len(shown) > 1, config)

    return Show(" ".join(one.name for one in shown), _blueprint(shown), log)


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
            recording.send_columns(f"{entity}/{name}", [stamp_column(stamps)], columns)

    line = rr.LineStrips3D.from_fields(colors=[colour], radii=[PATH_RADIUS])
    pieces = np.stack([positions[:-1], positions[1:]], axis=1)
    log("trajectory", line, stamps[1:], rr.LineStrips3D.columns(strips=[[piece] for piece in pieces]))
    loops = rr.LineStrips3D.columns(strips=[[loop] for loop in positions[run.loops]])
    log("loops", line, stamps[run.loops.max(axis=1, initial=0)], loops)
    place = rr.Points3D.from_fields(colors=[colour], radii=[2.5 * PATH_RADIUS], labels=[shown.name])
    log("lidar", place, stamps, rr.Points3D.columns(positions=positions))
    lost = rr.Points3D.from_fields(colors=[STATUS_COLOURS[Status.LOST]], radii=[2.0 * PATH_RADIUS])
    log("lost", lost, stamps[run.lost], rr.Points3D.columns(positions=positions[run.lost]))
    log_map(recording, f"{entity}/map", run.map_points, config.map_points, colour if several else None, static=True)
    if len(shown.errors_m):
        series = rr.new_entity_path([_ERRORS, shown.name])
        recording.log(series, rr.SeriesLines(names=shown.name, colors=[colour]), static=True)
        values = rr.Scalars.columns(scalars=shown.errors_m)
        recording.send_columns(series, [stamp_column(shown.error_stamps)], values)


def _blueprint(shown: Sequence[_Shown]) -> rrb.Blueprint:
    """One space for all, with the map of the first; the eye icon next to an entity's name shows and hides it."""
    overrides: dict[rr.encodings.EntityPath | str, rrb.VisibleTimeRanges | rrb.EntityBehavior] = {}
    for number, one in enumerate(shown):
        for name in ("trajectory", "loops", "lost"):
            overrides[f"{one.entity}/{name}"] = rrb.VisibleTimeRanges(whole_past())
        overrides[f"{one.entity}/map"] = rrb.EntityBehavior(visible=number == 0)
    space = rrb.Spatial3DView(origin="/world", name="Trajectories and maps", background=BACKGROUND, overrides=overrides)
    views: list[rrb.View] = [space]
    if any(len(one.errors_m) for one in shown):
        views.append(rrb.TimeSeriesView(origin=f"/{_ERRORS}", name="Distance to the ground truth [m]"))
    return rrb.Blueprint(
        rrb.Vertical(*views, row_shares=[4, 1][: len(views)]),
        rrb.TimePanel(timeline=TIME, play_state="following", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
    )
