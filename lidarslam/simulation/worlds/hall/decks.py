"""Ramps and decks of steel: slabs, kerbs, railings, columns underneath, and a flight of stairs."""

from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import UP, Builder
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.hall.plan import LANE_M, Deck, HallPlan, Ramp

_SLAB_M, _RAIL_M = 0.25, 1.1


def draw_decks(plan: HallPlan, builder: Builder, clearance: Clearance) -> None:
    """All ramps, decks and stairs; their space is taken."""
    for ramp in plan.ramps:
        _draw_ramp(ramp, builder, clearance)
    for deck in plan.decks:
        _draw_deck(deck, builder, clearance)
    _draw_stairs(plan, builder, clearance)


def _draw_ramp(ramp: Ramp, builder: Builder, clearance: Clearance) -> None:
    step = ramp.head - ramp.foot
    along = step / np.linalg.norm(step)
    side = np.array([-along[1], along[0], 0.0]) / np.hypot(along[0], along[1])
    down = 0.5 * _SLAB_M * np.cross(side, along)
    builder.beam(ramp.foot + down, ramp.head + down, LANE_M, _SLAB_M)
    for sign in (-1.0, 1.0):
        edge = sign * (0.5 * LANE_M - 0.06) * side
        builder.beam(ramp.foot + edge + 0.06 * UP, ramp.head + edge + 0.06 * UP, 0.12, 0.14)
        draw_railing(ramp.foot + edge, ramp.head + edge, builder)
    reach = np.abs(side) * 0.5 * LANE_M
    for k, (a, b) in enumerate(pairwise(np.linspace(0.0, 1.0, round(float(np.linalg.norm(step))) + 1))):
        low, high = ramp.foot + a * step, ramp.foot + b * step
        bottom, top = np.minimum(low, high) - reach, np.maximum(low, high) + reach
        clearance.take(bottom - (_SLAB_M + 0.25) * UP, top + _RAIL_M * UP)
        if k % 5 == 4 and low[2] > 1.0:
            for sign in (-1.0, 1.0):
                _stand(low + sign * (0.5 * LANE_M - 0.2) * side, _SLAB_M, builder, clearance)


def _stand(top: FloatArray, thickness: float, builder: Builder, clearance: Clearance) -> None:
    """A square column from the ground to below a slab, where the way and other things leave room."""
    low, high = np.append(top[:2] - 0.1, 0.0), np.append(top[:2] + 0.1, top[2] - thickness)
    if not clearance.on_route(low, high):
        clearance.take(low, high)
        builder.box(0.5 * (low + high), high - low + 0.1 * UP)


def draw_railing(a: FloatArray, b: FloatArray, builder: Builder) -> None:
    """Posts every 1.5 m or so, a hand rail and a knee rail, from a to b (3,)."""
    length = float(np.linalg.norm(b - a))
    for t in np.linspace(0.0, 1.0, max(2, round(length / 1.6) + 1)):
        foot = a + t * (b - a)
        builder.cylinder(foot, foot + _RAIL_M * UP, 0.025)
    for z in (0.55, _RAIL_M):
        builder.cylinder(a + z * UP, b + z * UP, 0.025)


def _draw_deck(deck: Deck, builder: Builder, clearance: Clearance) -> None:
    """Slab, beams below it, columns at its corners and between, railings along its open edges."""
    size = deck.high - deck.low
    low, high = np.append(deck.low, deck.z - _SLAB_M), np.append(deck.high, deck.z)
    builder.box(0.5 * (low + high), high - low)
    clearance.take(low - 0.35 * UP, high)
    xs, ys = (np.linspace(low[k] + 0.15, high[k] - 0.15, max(2, round(size[k] / 4.5) + 1)) for k in (0, 1))
    for x in xs:
        builder.box((x, 0.5 * (low[1] + high[1]), deck.z - _SLAB_M - 0.15), (0.18, size[1] - 0.02, 0.3))
        for y in ys:
            _stand(np.array([x, y, deck.z]), _SLAB_M + 0.3, builder, clearance)
    for a, b in deck.railings:
        draw_railing(np.append(a, deck.z), np.append(b, deck.z), builder)


def _draw_stairs(plan: HallPlan, builder: Builder, clearance: Clearance) -> None:
    """Steep stairs from the ground to deck 1, at its far end, between two stringers."""
    deck = plan.decks[0]
    steps = round(deck.z / 0.19)
    x, head = plan.width - 2.5, np.array([plan.width - 2.5, deck.low[1], deck.z])
    foot = np.array([x, deck.low[1] - 0.24 * steps, 0.0])
    for k in range(1, steps):
        point = foot + (head - foot) * k / steps
        builder.box(point - 0.02 * UP, (1.2, 0.26, 0.04))
    for side in (-0.64, 0.64):
        offset = np.array([side, 0.0, 0.0])
        builder.beam(foot + offset + 0.1 * UP, head + offset - 0.05 * UP, 0.05, 0.25)
        draw_railing(foot + offset, head + offset, builder)
    aside = np.array([0.8, 0.9, 0.0])
    clearance.take(foot - aside, head + aside + 1.5 * UP)
