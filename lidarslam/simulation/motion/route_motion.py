"""A carrier going round a world's route."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.motion.carriers import Carrier, Swing, find_carrier
from lidarslam.simulation.motion.ground_contact import ground_under
from lidarslam.simulation.motion.motions import CHANNELS, Motion, Sway
from lidarslam.simulation.motion.rounded_path import RoundedPath, corner_windows, straightened, turning_angles
from lidarslam.simulation.motion.speed_profile import TIME_STEP_S, invert, rest_to_rest, round_and_round, smoothed
from lidarslam.simulation.world import World

_REST_S = 1.0  # at the start of every lap
_SETTLE_S = 0.5  # at its end, for the sway to die down
_PAUSE_S = 0.3  # before and after turning on the spot
_PATH_STEP_M = 0.05
_LARGEST_WINDOW_M = 12.0
# Carriers that stop at gentler corners than this drive straight legs from stop to stop.
_DRIVES_STRAIGHT_DEG = 90.0
# Straight legs may leave the route sideways, hardly upwards.
_LIFT_WEIGHT = 4.0
_GRAVITY = 9.81


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Part of a lap at steps of `TIME_STEP_S`.

    Attributes:
        xy: (N, 2).
        lift: (N,) of the route above the ground of the world: mezzanines and ramps are no height fields.
        rise: (N,) of the lift for each metre forwards.
        yaw: (N,) continuous.
    """

    xy: FloatArray
    lift: FloatArray
    rise: FloatArray
    yaw: FloatArray


def motion_along_route(name: str, world: World, seed: int, speed_mps: float | None = None) -> Motion:
    """The named carrier on the world's route, its speed and sway varied by the seed.

    A lap starts and ends in the middle of the route's longest leg. Corners are rounded as far as the carrier and the
    route's free side allow, or taken by turning on the spot.

    Args:
        name: of the carrier.
        world: whose route it is.
        seed: of speed and sway.
        speed_mps: instead of the carrier's own and of the route's limit; bends are taken more slowly all the same.

    Raises:
        InputError: there is no such carrier, or it does not stop and the route has a corner that asks for it.
    """
    carrier = find_carrier(name)
    rng = np.random.default_rng([seed, *name.encode()])
    carrier = replace(carrier, speed_mps=carrier.speed_mps * rng.uniform(0.85, 1.1))
    if speed_mps is not None:
        carrier = replace(carrier, speed_mps=speed_mps)
        world = replace(world, route=replace(world.route, speed_limit_mps=speed_mps))
    base = _circuit(carrier, world) if carrier.keeps_going else _from_rest(carrier, world)
    times = np.linspace(0.0, TIME_STEP_S * (len(base) - 1), len(base))
    sway = seeded_sway(carrier, rng)
    return Motion(name, times, base, sway, carrier.sensor_height_m, rests=not carrier.keeps_going)


def seeded_sway(carrier: Carrier, rng: np.random.Generator) -> Sway:
    """The carrier's sines with random phases, frequencies within a tenth and amplitudes within a fifth of nominal."""
    gait = rng.uniform(0.9, 1.1)

    def frequency(swing: Swing) -> float:
        return swing.frequency_hz * (gait if swing.stepwise else rng.uniform(0.9, 1.1))

    def amplitude(swing: Swing) -> float:
        size = swing.amplitude * rng.uniform(0.8, 1.2)
        return float(np.deg2rad(size)) if swing.axis in ("roll", "pitch", "yaw") else size

    return Sway(
        tuple(CHANNELS.index(swing.axis) for swing in carrier.sway),
        tuple(amplitude(swing) for swing in carrier.sway),
        tuple(frequency(swing) for swing in carrier.sway),
        tuple(rng.uniform(0.0, 2.0 * np.pi) for _ in carrier.sway),
    )


def _from_rest(carrier: Carrier, world: World) -> FloatArray:
    """The base (N, 7) of a lap that begins and ends at rest."""
    stretches = _stretches(carrier, world)
    parts = (np.concatenate([getattr(one, part) for one in stretches]) for part in ("xy", "lift", "rise", "yaw"))
    return _on_the_ground(carrier, world, _Stretch(*parts))


def _circuit(carrier: Carrier, world: World) -> FloatArray:
    """The base (N, 7) of a lap at speed throughout, whose last pose is its first but for whole turns of yaw."""
    corners = _lap(carrier, world)[1:-1]
    if np.abs(turning_angles(corners)).max() > np.deg2rad(carrier.stop_angle_deg):
        raise InputError(f"{carrier.name} does not stop, and the route of {world.name} has a corner to turn round at")
    way = _drive(carrier, world, corners, is_closed=True)
    # Rates and averages over time need what comes before the lap and after it.
    count = round(_REST_S / TIME_STEP_S)
    turn = np.array(way.yaw[-1] - way.yaw[0])

    def around(values: FloatArray, gain: FloatArray) -> FloatArray:
        return np.concatenate([values[-count - 1 : -1] - gain, values, values[1 : count + 1] + gain])

    none = np.zeros(())
    wider = _Stretch(around(way.xy, none), around(way.lift, none), around(way.rise, none), around(way.yaw, turn))
    return _on_the_ground(carrier, world, wider)[count:-count]


def _stretches(carrier: Carrier, world: World) -> list[_Stretch]:
    """A lap: rest, then by turns driving and turning on the spot."""
    lap = _lap(carrier, world)
    angles = turning_angles(lap[:-1])
    stops = np.flatnonzero(np.abs(angles) > np.deg2rad(carrier.stop_angle_deg))
    bounds = [0, *stops[stops > 0], len(lap) - 1]
    stretches: list[_Stretch] = []
    for first, last in pairwise(bounds):
        drive = _drive(carrier, world, lap[first : last + 1])
        if stretches:
            stretches.append(_turn(carrier, stretches[-1], drive, float(angles[first])))
            turns = round((stretches[-1].yaw[-1] - drive.yaw[0]) / (2.0 * np.pi))
            drive = replace(drive, yaw=drive.yaw + 2.0 * np.pi * turns)
        else:
            stretches.append(_hold(drive, _REST_S, end=0))
        stretches.append(drive)
    return [*stretches, _hold(stretches[-1], _SETTLE_S, end=-1)]


def _lap(carrier: Carrier, world: World) -> FloatArray:
    """The route (M, 3) as x, y and lift above the ground, from the middle of its longest leg and back to it."""
    route = world.route
    vertices = route.waypoints.copy()
    vertices[:, 2] -= world.ground_at(vertices[:, :2])
    if carrier.stop_angle_deg < _DRIVES_STRAIGHT_DEG:
        stretched = vertices * [1.0, 1.0, _LIFT_WEIGHT]
        vertices = straightened(stretched, min(0.5, 0.3 * route.free_side_m)) / [1.0, 1.0, _LIFT_WEIGHT]
    following = np.roll(vertices, -1, axis=0)
    vertices = vertices[np.linalg.norm((following - vertices)[:, :2], axis=1) > 1e-3]
    legs = np.linalg.norm((np.roll(vertices, -1, axis=0) - vertices)[:, :2], axis=1)
    longest = int(legs.argmax())
    vertices = np.roll(vertices, -(longest + 1), axis=0)
    middle = 0.5 * (vertices[-1] + vertices[0])
    return np.concatenate([[middle], vertices, [middle]])


def _drive(carrier: Carrier, world: World, vertices: FloatArray, is_closed: bool = False) -> _Stretch:
    """From rest to rest along a polyline (M, 3), or at speed round a closed one from the middle of its last leg."""
    route = world.route
    if is_closed:
        vertices = np.concatenate([vertices[-2:], vertices, vertices[:2]])
    cut = max(min(route.free_side_m - carrier.half_width_m, route.corner_radius_m), 0.2 * route.free_side_m)
    windows = corner_windows(vertices, _LARGEST_WINDOW_M, cut)
    path = RoundedPath(vertices, windows)
    begin, end = (path.lengths[[1, -3]] + path.lengths[[2, -2]]) / 2.0 if is_closed else path.lengths[[0, -1]]
    u = np.linspace(begin, end, max(int((end - begin) / _PATH_STEP_M), 20) + 1)
    _, first, second = path.at(u)
    stretch = np.hypot(first[:, 0], first[:, 1])
    s = np.concatenate([[0.0], np.cumsum(0.5 * (stretch[1:] + stretch[:-1]) * np.diff(u))])
    bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / stretch**3
    bend = np.maximum(bend, 1e-6)
    limits = np.minimum(np.sqrt(carrier.side_acceleration / bend), np.deg2rad(carrier.turn_rate_deg) / bend)
    limits = np.minimum(limits, min(carrier.speed_mps, route.speed_limit_mps))
    profile = round_and_round if is_closed else rest_to_rest
    travelled, _ = profile(s, limits, carrier.acceleration, carrier.smoothing_s)
    u = np.clip(np.maximum.accumulate(invert(s, u)(travelled)), begin, end)
    where, first, _ = path.at(u)
    # A ramp's foot is rounded by no more than the body's own length.
    lift, climb, _ = RoundedPath(vertices, np.minimum(windows, 2.0 * carrier.footprint_m)).at(u)
    yaw = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
    return _Stretch(where[:, :2], lift[:, 2], climb[:, 2] / np.hypot(first[:, 0], first[:, 1]), yaw)


def _turn(carrier: Carrier, before: _Stretch, after: _Stretch, angle: float) -> _Stretch:
    """Turn on the spot from the end of one stretch to the start of the next, there and back as the carrier does."""
    targets = [*np.deg2rad(np.sign(angle) * np.array(carrier.swings_deg)), 0.0]
    yaw, headings = float(before.yaw[-1]), []
    for target in targets:
        change = before.yaw[-1] + angle + target - yaw
        way = np.linspace(0.0, abs(change), 201)
        limits = np.full(len(way), np.deg2rad(carrier.turn_rate_deg))
        turned, _ = rest_to_rest(way, limits, np.deg2rad(carrier.turn_acceleration_deg), carrier.smoothing_s)
        headings.append(yaw + np.sign(change) * turned)
        yaw += change
    pause = round(_PAUSE_S / TIME_STEP_S)
    heading = np.pad(np.concatenate(headings), pause, mode="edge")
    done = (heading - heading[0]) / (heading[-1] - heading[0])
    spot = np.broadcast_to(after.xy[0], (len(heading), 2))
    rise = before.rise[-1] + np.clip(done, 0.0, 1.0) * (after.rise[0] - before.rise[-1])
    return _Stretch(spot, np.full(len(heading), after.lift[0]), rise, heading)


def _hold(stretch: _Stretch, duration_s: float, end: int) -> _Stretch:
    count = round(duration_s / TIME_STEP_S)
    held = (np.repeat(part[[end]], count, axis=0) for part in (stretch.xy, stretch.lift, stretch.rise, stretch.yaw))
    return _Stretch(*held)


def _on_the_ground(carrier: Carrier, world: World, way: _Stretch) -> FloatArray:
    """The base (N, 7) of the motion: the way put on the ground, with what attitude the carrier takes from it."""
    ground = ground_under(world, way.xy, carrier.footprint_m)
    flight = min(carrier.flight_height_m, 0.5 * world.route.free_height_m)
    z = ground.height + way.lift + flight
    roll, pitch = np.zeros(len(z)), np.zeros(len(z))
    c, s = np.cos(way.yaw), np.sin(way.yaw)
    if carrier.leans_with_ground:
        pitch -= np.arctan(c * ground.slope[:, 0] + s * ground.slope[:, 1] + way.rise)
        roll += np.arctan(c * ground.slope[:, 1] - s * ground.slope[:, 0])
    velocity = np.gradient(way.xy, TIME_STEP_S, axis=0)
    if carrier.banks:
        ax, ay = np.gradient(velocity, TIME_STEP_S, axis=0).T
        pitch += np.arctan(smoothed(c * ax + s * ay, carrier.smoothing_s) / _GRAVITY)
        roll -= np.arctan(smoothed(c * ay - s * ax, carrier.smoothing_s) / _GRAVITY)
    speed = np.hypot(*velocity.T) + 0.3 * np.abs(np.gradient(way.yaw, TIME_STEP_S))
    activity = smoothed(np.minimum(speed / (0.5 * carrier.speed_mps), 1.0), _SETTLE_S - TIME_STEP_S)
    return np.stack([way.xy[:, 0], way.xy[:, 1], z, roll, pitch, way.yaw, activity], axis=-1)
