"""Motion of a carrier along a world's route.

A lap is a chain of stretches: arrays (N, 5) of x, y, lift, rise and yaw at steps of `TIME_STEP_S`. The lift is the
height of the route above the ground of the world (mezzanines and ramps are no height fields), the rise its gain for
each metre forwards; yaw is continuous.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.imu import GRAVITY
from lidarslam.simulation.motion import CARRIERS, CHANNELS, Carrier, Motion, Sway, ground_under
from lidarslam.simulation.world import World, choose
from lidarslam.simulation.worlds.paths import lengths_along, turning_angles


@dataclass(frozen=True, eq=False)
class RoundedPath:
    """An open polyline, averaged over a window that slides along it.

    With u the length along the polyline and k the window (15/16h)(1 - (x/h)^2)^2 of half width h, the path is the
    polyline convolved with k: straight where the polyline is straight within h, its second derivative at a corner the
    change of direction times k. Each corner has its own h, so that there are closed forms throughout.
    """

    vertices: FloatArray  # (M, D) of the polyline
    half_widths: FloatArray  # (M,) of the window at each vertex; the ends are not rounded

    @cached_property
    def lengths(self) -> FloatArray:
        """(M,) length along the polyline at each vertex; the path's parameter u."""
        return lengths_along(self.vertices[:, :2])

    @cached_property
    def _directions(self) -> FloatArray:
        return np.diff(self.vertices, axis=0) / np.diff(self.lengths)[:, None]

    def at(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points (N, D) and their first and second derivatives by u, at increasing u (N,)."""
        leg = np.clip(np.searchsorted(self.lengths, u, side="right") - 1, 0, len(self._directions) - 1)
        first = self._directions[leg]
        points = self.vertices[leg] + (u - self.lengths[leg])[:, None] * first
        second = np.zeros_like(points)
        for corner in range(1, len(self.vertices) - 1):
            h = self.half_widths[corner]
            near = slice(*np.searchsorted(u, [self.lengths[corner] - h, self.lengths[corner] + h]))
            x = u[near] - self.lengths[corner]
            ramp, step, bump = _window(x / h)
            change = self._directions[corner] - self._directions[corner - 1]
            points[near] += np.multiply.outer(h * ramp - np.maximum(x, 0.0), change)
            first[near] += np.multiply.outer(step - (x >= 0.0), change)
            second[near] += np.multiply.outer(bump / h, change)
        return points, first, second


def _window(z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The window of half width 1 and its first two integrals, the last first, for z in [-1, 1]."""
    z2 = z * z
    bump = 15.0 / 16.0 * (1.0 - z2) ** 2
    step = 0.5 + 15.0 / 16.0 * z * (1.0 - z2 * (2.0 / 3.0 - z2 / 5.0))
    ramp = 5.0 / 32.0 + 0.5 * z + 15.0 / 16.0 * z2 * (0.5 - z2 * (1.0 / 6.0 - z2 / 30.0))
    return ramp, step, bump


def corner_windows(vertices: FloatArray, corner_m: float, cut_m: float) -> FloatArray:
    """Half widths (M,) for an open polyline (M, >=2).

    At a corner that turns by a, the path stays 5/16 h sin(a/2) inside it, at most `cut_m`, and the window ends at the
    neighbouring vertices: a chain of short legs becomes one even bend, a lone corner spreads over `corner_m` at most.
    """
    legs = np.linalg.norm(np.diff(vertices[:, :2], axis=0), axis=1)
    angles = turning_angles(vertices)[1:-1]
    inside = cut_m / np.maximum(5.0 / 16.0 * np.sin(0.5 * np.abs(angles)), 1e-6)
    h = np.minimum(np.minimum(legs[:-1], legs[1:]), np.minimum(inside, corner_m))
    return np.concatenate([[0.0], h, [0.0]])


def straightened(vertices: FloatArray, tolerance_m: float) -> FloatArray:
    """The fewest vertices of a closed polyline (M, 3) that keep it within `tolerance_m` (Douglas and Peucker)."""
    closed = np.concatenate([vertices, vertices[:1]])

    def kept(first: int, last: int) -> list[int]:
        """The vertices to keep, from the first to before the last."""
        chord = closed[last] - closed[first]
        offsets = closed[first + 1 : last] - closed[first]
        along = np.clip(offsets @ chord / max(float(chord @ chord), 1e-12), 0.0, 1.0)
        distance = np.linalg.norm(offsets - along[:, None] * chord, axis=1)
        if distance.max(initial=0.0) <= tolerance_m:
            return [first]
        middle = first + 1 + int(distance.argmax())
        return kept(first, middle) + kept(middle, last)

    farthest = int(np.linalg.norm(vertices - vertices[0], axis=1).argmax())
    return np.asarray(vertices[kept(0, farthest) + kept(farthest, len(vertices))])


TIME_STEP_S = 0.01


def rest_to_rest(
    positions: FloatArray, speed_limits: FloatArray, acceleration: float, smoothing_s: float
) -> FloatArray:
    """Positions (N,) at steps of `TIME_STEP_S` on the fastest motion that keeps the limits (M,) at positions (M,).

    The fastest motion has constant acceleration between the limits; averaged in time over a window of `smoothing_s`
    to either side it keeps both limits on speed and acceleration (an average of values within a limit is within it
    too), and its acceleration is continuous.
    """
    limits = speed_limits.copy()
    limits[[0, -1]] = 0.0
    speeds = _within_acceleration(positions, limits, acceleration)
    times = _arrivals(positions, speeds)
    moments = TIME_STEP_S * np.arange(int(np.ceil(times[-1] / TIME_STEP_S)) + 1, dtype=np.float64)
    return smoothed(_travelled(positions, speeds, times, moments), smoothing_s, ends="rest")


def round_and_round(
    positions: FloatArray, speed_limits: FloatArray, acceleration: float, smoothing_s: float
) -> FloatArray:
    """As `rest_to_rest` for one lap of a closed path, whose last position is the first: at speed where it closes.

    The lap's time is rounded up to whole steps, all speeds that much lower.
    """
    lap = positions[-1]
    three = np.concatenate([positions[:-1], positions[:-1] + lap, positions + 2.0 * lap])
    limits = np.concatenate([speed_limits[:-1], speed_limits[:-1], speed_limits])
    middle = slice(len(positions) - 1, 2 * len(positions) - 1)
    speeds = _within_acceleration(three, limits, acceleration)[middle]
    times = _arrivals(positions, speeds)
    steps = int(np.ceil(times[-1] / TIME_STEP_S))
    travelled = _travelled(positions, speeds, times, float(times[-1]) / steps * np.arange(steps + 1, dtype=np.float64))
    smooth = smoothed(np.concatenate([travelled[:-1] - lap, travelled, travelled[1:] + lap]), smoothing_s)
    return np.asarray(smooth[steps : 2 * steps + 1] - smooth[steps])


def _within_acceleration(positions: FloatArray, speed_limits: FloatArray, acceleration: float) -> FloatArray:
    """The highest speeds (M,) within the limits (M,) that constant acceleration can reach and leave in time."""
    gain = 2.0 * acceleration * positions
    squares = gain + np.minimum.accumulate(speed_limits**2 - gain)
    squares = np.minimum.accumulate((squares + gain)[::-1])[::-1] - gain
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


def _arrivals(positions: FloatArray, speeds: FloatArray) -> FloatArray:
    """Times (M,) at the positions (M,), from 0."""
    return np.concatenate([[0.0], np.cumsum(2.0 * np.diff(positions) / (speeds[:-1] + speeds[1:]))])


def _travelled(positions: FloatArray, speeds: FloatArray, times: FloatArray, moments: FloatArray) -> FloatArray:
    """Positions (N,) at moments (N,), with constant acceleration between the positions (M,)."""
    piece = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    since = np.minimum(moments, times[-1]) - times[piece]
    rise = np.diff(speeds)[piece] / np.diff(times)[piece]
    return np.asarray(positions[piece] + since * (speeds[piece] + 0.5 * rise * since))


def smoothed(values: FloatArray, half_width_s: float, ends: str = "same") -> FloatArray:
    """Values (N,) at steps of `TIME_STEP_S` averaged over a window of twice that width, the first and last held.

    Ends "same" keep the number of values; "rest" adds the window's width, so that the result starts and ends exactly
    at the first and last value.
    """
    n = max(round(half_width_s / TIME_STEP_S), 1)
    weights = (1.0 - (np.arange(-n, n + 1) / (n + 1.0)) ** 2) ** 2
    padded = np.pad(values, n if ends == "same" else 2 * n, mode="edge")
    return np.asarray(np.convolve(padded, weights / weights.sum(), mode="valid"))


_REST_S = 1.0  # at the start of every lap
_SETTLE_S = 0.5  # at its end, for the sway to die down
_PAUSE_S = 0.3  # before and after turning on the spot
_PATH_STEP_M = 0.05
_LARGEST_WINDOW_M = 12.0
# Carriers that stop at gentler corners than this drive straight legs from stop to stop.
_DRIVES_STRAIGHT_DEG = 90.0
# Straight legs may leave the route sideways, hardly upwards.
_LIFT_WEIGHT = np.array([1.0, 1.0, 4.0])


def motion_along_route(name: str, world: World, seed: int, speed_mps: float | None = None) -> Motion:
    """The named carrier on the world's route, its speed and sway varied by the seed.

    A lap starts and ends in the middle of the route's longest leg. Corners are rounded as far as the carrier and the
    route's free side allow, or taken by turning on the spot. A given `speed_mps` replaces the carrier's own and the
    route's limit; bends are taken more slowly all the same.

    Raises:
        InputError: there is no such carrier, or it does not stop and the route has a corner that asks for it.
    """
    carrier = choose("motion", name, CARRIERS)
    rng = np.random.default_rng([seed, *name.encode()])
    carrier = replace(carrier, speed_mps=carrier.speed_mps * rng.uniform(0.85, 1.1))
    if speed_mps is not None:
        carrier = replace(carrier, speed_mps=speed_mps)
        world = replace(world, route=replace(world.route, speed_limit_mps=speed_mps))
    base = _circuit(carrier, world) if carrier.keeps_going else _from_rest(carrier, world)
    times = np.linspace(0.0, TIME_STEP_S * (len(base) - 1), len(base))
    return Motion(name, times, base, carrier.sensor_height_m, _seeded_sway(carrier, rng), rests=not carrier.keeps_going)


def _seeded_sway(carrier: Carrier, rng: np.random.Generator) -> Sway:
    """The carrier's sines with random phases, frequencies within a tenth and amplitudes within a fifth of nominal."""
    gait, sines = rng.uniform(0.9, 1.1), carrier.sway
    units = [np.pi / 180.0 if swing.axis in ("roll", "pitch", "yaw") else 1.0 for swing in sines]
    sizes = [s.amplitude * rng.uniform(0.8, 1.2) * unit for s, unit in zip(sines, units, strict=True)]
    rates_hz = [s.frequency_hz * (gait if s.stepwise else rng.uniform(0.9, 1.1)) for s in sines]
    phases = [rng.uniform(0.0, 2.0 * np.pi) for _ in sines]
    axes = [CHANNELS.index(swing.axis) for swing in sines]
    return tuple(zip(axes, sizes, rates_hz, phases, strict=True))


def _circuit(carrier: Carrier, world: World) -> FloatArray:
    """The base (N, 7) of a lap at speed throughout, whose last pose is its first but for whole turns of yaw."""
    corners = _lap(carrier, world)[1:-1]
    if np.abs(turning_angles(corners)).max() > np.deg2rad(carrier.stop_angle_deg):
        raise InputError(f"{carrier.name} does not stop, and the route of {world.name} has a corner to turn round at")
    way = _drive(carrier, world, corners, is_closed=True)
    # Rates and averages over time need the paths before the lap and after it.
    count = round(_REST_S / TIME_STEP_S)
    gain = np.append(np.zeros(4), way[-1, 4] - way[0, 4])
    wider = np.concatenate([way[-count - 1 : -1] - gain, way, way[1 : count + 1] + gain])
    return _on_the_ground(carrier, world, wider)[count:-count]


def _from_rest(carrier: Carrier, world: World) -> FloatArray:
    """The base (N, 7) of a lap: rest, then driving and turning on the spot alternately, and rest."""
    lap = _lap(carrier, world)
    angles = turning_angles(lap[:-1])
    stops = np.flatnonzero(np.abs(angles) > np.deg2rad(carrier.stop_angle_deg))
    bounds = [0, *stops[stops > 0], len(lap) - 1]
    stretches: list[FloatArray] = []
    for first, last in pairwise(bounds):
        drive = _drive(carrier, world, lap[first : last + 1])
        if stretches:
            stretches.append(_turn(carrier, stretches[-1], drive, float(angles[first])))
            drive[:, 4] += 2.0 * np.pi * round((stretches[-1][-1, 4] - drive[0, 4]) / (2.0 * np.pi))
        stretches.append(drive)
    start = np.repeat(stretches[0][:1], round(_REST_S / TIME_STEP_S), axis=0)
    end = np.repeat(stretches[-1][-1:], round(_SETTLE_S / TIME_STEP_S), axis=0)
    return _on_the_ground(carrier, world, np.concatenate([start, *stretches, end]))


def _lap(carrier: Carrier, world: World) -> FloatArray:
    """The route (M, 3) as x, y and lift above the ground, from the middle of its longest leg and back to it."""
    vertices = world.route.waypoints.copy()
    vertices[:, 2] -= world.ground_at(vertices[:, :2])
    if carrier.stop_angle_deg < _DRIVES_STRAIGHT_DEG:
        vertices = straightened(vertices * _LIFT_WEIGHT, min(0.5, 0.3 * world.route.free_side_m)) / _LIFT_WEIGHT
    vertices = vertices[np.linalg.norm((np.roll(vertices, -1, axis=0) - vertices)[:, :2], axis=1) > 1e-3]
    legs = np.linalg.norm((np.roll(vertices, -1, axis=0) - vertices)[:, :2], axis=1)
    vertices = np.roll(vertices, -(int(legs.argmax()) + 1), axis=0)
    middle = 0.5 * (vertices[-1] + vertices[0])
    return np.concatenate([[middle], vertices, [middle]])


def _drive(carrier: Carrier, world: World, vertices: FloatArray, is_closed: bool = False) -> FloatArray:
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
    travelled = CubicSpline(s, u)(profile(s, limits, carrier.acceleration, carrier.smoothing_s))
    u = np.clip(np.maximum.accumulate(travelled), u[0], u[-1])  # never back
    where, first, _ = path.at(u)
    # A ramp's foot is rounded by no more than the body's own length.
    lift, climb, _ = RoundedPath(vertices, np.minimum(windows, 2.0 * carrier.footprint_m)).at(u)
    rise = climb[:, 2] / np.hypot(first[:, 0], first[:, 1])
    return np.column_stack([where[:, :2], lift[:, 2], rise, np.unwrap(np.arctan2(first[:, 1], first[:, 0]))])


def _turn(carrier: Carrier, before: FloatArray, after: FloatArray, angle: float) -> FloatArray:
    """Turn on the spot from the end of one stretch to the start of the next, there and back as the carrier does."""
    targets = [*np.deg2rad(np.sign(angle) * np.array(carrier.swings_deg)), 0.0]
    yaw, headings = float(before[-1, 4]), []
    for target in targets:
        change = before[-1, 4] + angle + target - yaw
        way = np.linspace(0.0, abs(change), 201)
        limits = np.full(len(way), np.deg2rad(carrier.turn_rate_deg))
        turned = rest_to_rest(way, limits, np.deg2rad(carrier.turn_acceleration_deg), carrier.smoothing_s)
        headings.append(yaw + np.sign(change) * turned)
        yaw += change
    heading = np.pad(np.concatenate(headings), round(_PAUSE_S / TIME_STEP_S), mode="edge")
    done = np.clip((heading - heading[0]) / (heading[-1] - heading[0]), 0.0, 1.0)
    turn = np.repeat(after[:1], len(heading), axis=0)
    turn[:, 3], turn[:, 4] = before[-1, 3] + done * (after[0, 3] - before[-1, 3]), heading
    return turn


def _on_the_ground(carrier: Carrier, world: World, way: FloatArray) -> FloatArray:
    """The base (N, 7) of the motion: the path on the ground, with the attitude that the carrier takes from it."""
    xy, (lift, rise, yaw) = way[:, :2], way[:, 2:].T
    height, slope = ground_under(world, xy, carrier.footprint_m)
    c, s = np.cos(yaw), np.sin(yaw)
    flight = min(carrier.flight_height_m, 0.5 * world.route.free_height_m)
    z = height + lift + flight
    roll, pitch = np.zeros(len(z)), np.zeros(len(z))
    if carrier.leans_with_ground:
        pitch -= np.arctan(c * slope[:, 0] + s * slope[:, 1] + rise)
        roll += np.arctan(c * slope[:, 1] - s * slope[:, 0])
    velocity = np.gradient(xy, TIME_STEP_S, axis=0)
    if carrier.banks:
        ax, ay = np.gradient(velocity, TIME_STEP_S, axis=0).T
        pitch += np.arctan(smoothed(c * ax + s * ay, carrier.smoothing_s) / GRAVITY)
        roll -= np.arctan(smoothed(c * ay - s * ax, carrier.smoothing_s) / GRAVITY)
    speed = np.hypot(*velocity.T) + 0.3 * np.abs(np.gradient(yaw, TIME_STEP_S))
    activity = smoothed(np.minimum(speed / (0.5 * carrier.speed_mps), 1.0), _SETTLE_S - TIME_STEP_S)
    return np.column_stack([xy, z, roll, pitch, yaw, activity])
