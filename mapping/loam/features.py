"""Edges and planes among the points of a scan, after LOAM (Zhang and Singh, RSS 2014)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import one_per_cell
from mapping.loam.config import FeatureConfig
from mapping.loam.planarity import planar_points, plane_cell_for
from mapping.loam.ring_curves import RingCurves, bend_across, measure_curves
from mapping.loam.ring_layout import Indices, lay_out
from mapping.loam.ring_picks import local_maxima, rank_in_sector


@dataclass(frozen=True, eq=False)
class Features:
    """Points of a scan that say something about where it was taken; indices into its points, ascending.

    Attributes:
        edges: (E,) on corners and at the near side of steps in depth.
        planes: (P,) on smooth surfaces, thinned.
        sharp: (S,) the sharpest edges.
        flat: (F,) the flattest planes.
    """

    edges: Indices
    planes: Indices
    sharp: Indices
    flat: Indices


def extract_features(points: FloatArray, rings: NDArray[np.integer] | None, config: FeatureConfig) -> Features:
    """Find a scan's edges and planes.

    Curvature is LOAM's, c = |sum of 5 neighbours to either side - 10 p|^2 along a ring, not divided by the range, and
    so are thresholds, quotas and what is rejected: points behind steps in depth and on surfaces along the beam. It
    differs from LOAM in this:

    - a ring closes on itself, so points should be motion compensated, or its two ends may make an edge;
    - windows with a hole in them, that is without returns, make no features;
    - points nearer together than `min_spacing_m` are skipped, or noise would hide corners close by;
    - an edge must bend across the ring's own direction, and more than the noise of its window would;
    - the picks are found all at once (see `local_maxima`), their quotas applied afterwards.

    Args:
        points: (N, 3) in the LiDAR frame.
        rings: (N,) the laser of every point, any numbering; None for sensors without rings, which have planes only.
        config: thresholds and quotas.
    """
    if rings is None:
        planes = planar_points(points, _cell(points, config))
        return Features(_none(), planes, _none(), planes)
    layout = lay_out(points, rings, config.min_spacing_m)
    if layout is None:
        return Features(_none(), _none(), _none(), _none())
    curves = measure_curves(layout, config.max_gap_columns)
    edges, sharp, straight = _pick_edges(curves, config)
    planes, flat = _pick_planes(points, curves, straight, config)
    return Features(edges, planes, sharp, flat)


def _pick_edges(curves: RingCurves, config: FeatureConfig) -> tuple[Indices, Indices, Indices]:
    """The edges, the sharp among them, and the places whose curvature is due to uneven spacing only."""
    places = np.flatnonzero(curves.reliable & (curves.curvature > config.edge_curvature_m2))
    across = bend_across(curves, places)
    # Beside a step in depth only its very brink is an edge, and no noise is as large.
    above_noise = across > config.edge_over_noise**2 * curves.noise[places]
    significant = np.where(curves.jumps[places], curves.brinks[places], above_noise)
    bent = significant & (across > config.edge_curvature_m2)
    straight = places[across < config.plane_curvature_m2]
    places, sharpness = places[bent], across[bent]
    peaks = local_maxima(curves, places, sharpness)
    rank = rank_in_sector(curves.layout.sectors(places[peaks], config.sectors), -sharpness[peaks])
    picked = curves.layout.source[places[peaks]]
    sharp = np.sort(picked[rank < config.sharp_per_sector])
    return np.sort(picked[rank < config.edges_per_sector]), sharp, straight


def _pick_planes(
    points: FloatArray, curves: RingCurves, straight: Indices, config: FeatureConfig
) -> tuple[Indices, Indices]:
    """Points of little curvature, thinned along the rings and across them, and the flat among them.

    `straight` are places whose curvature is due to uneven spacing only.
    """
    smooth = curves.reliable & (curves.curvature < config.plane_curvature_m2)
    smooth[straight] = True
    places = np.flatnonzero(smooth)
    cell_m = _cell(points, config)
    if cell_m > 0.0:
        pieces = (curves.lengths()[places] * (2.0 / cell_m)).astype(np.int64)
        kept = np.diff(pieces, prepend=-1) != 0
        # Each ring begins with one.
        first = np.searchsorted(places, curves.layout.starts)
        kept[first[first < len(places)]] = True
        places = places[kept]
    picked = curves.layout.source[places]
    order = np.argsort(picked)
    picked, places = picked[order], places[order]
    if cell_m > 0.0:
        single = one_per_cell(points[picked], cell_m)
        picked, places = picked[single], places[single]
    rank = rank_in_sector(curves.layout.sectors(places, config.sectors), curves.curvature[places])
    return picked, picked[rank < config.flat_per_sector]


def _cell(points: FloatArray, config: FeatureConfig) -> float:
    return plane_cell_for(points) if config.plane_cell_m is None else config.plane_cell_m


def _none() -> Indices:
    return np.empty(0, dtype=np.intp)
