"""Which loops to believe: graduated non-convexity with truncated least squares.

Yang, Antonante, Tzoumas and Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020. A loop whose
squared residual is above a limit should cost that much and pull no more. From far away such a cost has no slope, so one
begins with a cost under which every loop pulls a little, and sharpens it step by step.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from mapping.pose_graph.pose_graph_config import PoseGraphConfig

# The start is no flatter than this, however far off a loop is.
_FLATTEST = 1e-8
# How often decided loops are looked at again.
_SECOND_LOOKS = 5

Solve = Callable[[FloatArray], FloatArray]


def decide(loops: NDArray[np.bool_], solve: Solve, config: PoseGraphConfig) -> FloatArray:
    """Weights (E,) of edges: 1 for those that are no loops, 1 or 0 for loops (E,) that are believed or not.

    `solve` optimises the poses under given weights (E,), and returns the edges' squared residuals (E,) there. It may
    begin where it ended, but not when no loop has a weight: before that, false loops may have bent everything. The last
    call is with the weights that are returned.
    """
    limit = config.loop_limit_sigmas**2
    everything = np.ones(len(loops))
    squares = solve(everything)
    cost = _cost(squares, loops, limit)
    if not loops.any() or cost <= limit:  # without any one loop it could not be less than that loop's limit
        return everything
    all_fit = bool((squares[loops] <= limit).all())
    weights, squares = _graduate(loops, solve, limit, config)
    for _ in range(_SECOND_LOOKS):
        believed = np.where(loops, squares <= limit, 1.0)
        if np.array_equal(believed, weights):
            break
        weights = believed
        squares = solve(weights)
    if all_fit and cost < _cost(squares, loops, limit):
        weights = everything
        solve(weights)
    return weights


def _cost(squares: FloatArray, loops: NDArray[np.bool_], limit: float) -> float:
    """What graduated non-convexity makes small: truncated for loops."""
    return float(np.where(loops, np.minimum(squares, limit), squares).sum())


def _graduate(
    loops: NDArray[np.bool_], solve: Solve, limit: float, config: PoseGraphConfig
) -> tuple[FloatArray, FloatArray]:
    weights = np.where(loops, 0.0, 1.0)
    squares = solve(weights)
    sharpness = max(_FLATTEST, limit / max(limit, 2.0 * float(squares[loops].max()) - limit))
    for _ in range(config.max_steps):
        weights = np.where(loops, truncated_weights(squares, sharpness, limit), 1.0)
        squares = solve(weights)
        if ((weights == 0.0) | (weights == 1.0)).all():
            break
        sharpness *= config.convexity_step
    return weights, squares


def truncated_weights(squares: FloatArray, sharpness: float, limit: float) -> FloatArray:
    """Weights (L,) in [0, 1] of squared residuals (L,): 1 well below the limit, 0 well above (equation 14)."""
    # Below this a weight is 1; dividing by less than it would be dividing by nothing.
    least = limit * sharpness / (sharpness + 1.0)
    between = np.sqrt(limit * sharpness * (sharpness + 1.0) / np.maximum(squares, least)) - sharpness
    return np.asarray(np.where(squares <= least, 1.0, np.clip(between, 0.0, 1.0)), dtype=np.float64)
