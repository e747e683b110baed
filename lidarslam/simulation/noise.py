"""Measurement noise: pure functions of the true ranges, the sensor's figures and random numbers.

All take and give whole sweeps (N,), in the order of the pattern's rays, so that the effects on one ray do not
depend on the number of other returns; inf stands for no return.
"""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.sensors import RangeModel
from lidarslam.simulation.world import Grass

# A surface seen at a smaller cosine than this (87 degrees) behaves as at it.
_LEAST_COSINE = 0.05
# The share of the range spread over a slanted footprint that shows as noise: the deviation of a uniform distribution
# would be 0.29, a beam is brighter in its middle.
_FOOTPRINT_SHARE = 0.2
_EDGE_STEP_M = 0.3
_EDGE_STEP_SHARE = 0.03
_MIXED_STEP_M = 1.5
_REFERENCE_REFLECTIVITY = 0.8
# Stands for the range of a ray that meets nothing, where it has to be compared.
_NOTHING_M = 1e6
# The tips of the blades are between this share of the grass's height and all of it.
_SHORTEST_BLADE = 0.5


def reflectivity(surfaces: NDArray[np.int64]) -> FloatArray:
    """Reflectivity (N,) in [0.1, 0.8] of the surfaces (N,) met; equal for a solid's neighbouring triangles.

    Numbers are scattered by Knuth's multiplicative hashing, four successive triangles together.
    """
    scattered = (np.abs(surfaces) // 4 * 2654435761) % 2**32
    return 0.1 + 0.7 * np.asarray(scattered, dtype=np.float64) / 2**32


def range_sigma(model: RangeModel, ranges: FloatArray, cosines: FloatArray) -> FloatArray:
    """Standard deviation (N,) of the range noise: electronics and the depth of a slanted footprint."""
    cosines = np.maximum(cosines, _LEAST_COSINE)
    electronics = model.sigma_m + model.sigma_per_m * ranges
    depth = ranges * model.beam_divergence * np.sqrt(1.0 - np.minimum(cosines, 1.0) ** 2) / cosines
    return np.asarray(np.hypot(electronics, _FOOTPRINT_SHARE * depth))


def return_probability(
    model: RangeModel, ranges: FloatArray, cosines: FloatArray, reflectivities: FloatArray
) -> FloatArray:
    """Probability (N,) that a ray comes back.

    The echo's power falls with reflectivity * cosine / range^2; detection falls from certain to none around the
    power of a surface of 80 % reflectivity met head-on at the maximum range. The fourth power makes the transition as
    wide as the published 10 % and 90 % ranges are apart.
    """
    power = reflectivities / _REFERENCE_REFLECTIVITY * np.maximum(cosines, _LEAST_COSINE)
    weakness = (ranges / model.max_range_m) ** 2 / power
    return np.asarray((1.0 - model.dropout) / (1.0 + weakness**4))


def bloom(
    model: RangeModel, ranges: FloatArray, lasers: int, column_angle: float, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Ranges (N,) with the edges of near things widened, and which of them (N,) changed.

    Next to an edge a ray behind it still touches it with part of its footprint: with the chance that its centre is
    less than half a beam away. It then returns the near range, or, where both surfaces are close enough to make one
    echo, something between.
    """
    finite = np.minimum(ranges, _NOTHING_M)
    grid = finite.reshape(-1, lasers)
    neighbour = np.minimum(np.roll(grid, 1, axis=0), np.roll(grid, -1, axis=0)).ravel()
    chance, mixing = rng.random((2, len(ranges)), dtype=np.float32)
    step = finite - neighbour
    edge = step > np.maximum(_EDGE_STEP_M, _EDGE_STEP_SHARE * finite)
    edge &= chance < 0.5 * model.beam_divergence / column_angle
    bloomed = ranges.copy()
    bloomed[edge] = (neighbour + np.where(step < _MIXED_STEP_M, mixing * step, 0.0))[edge]
    return bloomed, edge


def measure(
    model: RangeModel, ranges: FloatArray, cosines: FloatArray, reflectivities: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Measured ranges (N,), inf where there is none: noise, rounding, dropouts, limits."""
    noise = rng.standard_normal(len(ranges), dtype=np.float32)
    lost = rng.random(len(ranges), dtype=np.float32)
    returned = np.isfinite(ranges)
    true = np.where(returned, ranges, 1.0)
    measured = true + noise * range_sigma(model, true, cosines)
    measured = np.round(measured / model.resolution_m) * model.resolution_m
    returned &= lost < return_probability(model, true, cosines, reflectivities)
    returned &= (measured >= model.min_range_m) & (measured <= model.max_range_m)
    return np.where(returned, measured, np.inf)


def intensities(cosines: FloatArray, reflectivities: FloatArray) -> NDArray[np.float32]:
    """Calibrated intensities (N,), whole numbers on the drivers' scale of 0 to 255, without the effect of range."""
    return np.round(255.0 * reflectivities * cosines).astype(np.float32)


def ranges_in_grass(
    grass: Grass, points: FloatArray, ranges: FloatArray, cosines: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Ranges (N,) of rays to points (N, 3) on the ground that blades may shorten, and which (N,) ended at a blade.

    The path among blades of height h at incidence cosine c is h / c long; until a blade is met it is exponentially
    distributed (Beer and Lambert's law). Close by most rays reach the ground, far away hardly any.
    """
    tips = grass.heights.height_at(points[:, :2]) * rng.uniform(_SHORTEST_BLADE, 1.0, len(points))
    path = np.minimum(tips / np.maximum(cosines, _LEAST_COSINE), ranges)
    until_blade = rng.exponential(grass.free_path_m, len(points))
    is_blade = until_blade < path
    return ranges - np.where(is_blade, path - until_blade, 0.0), is_blade
