"""Houses of few boxes, for streets of many kilometres; drawn in the frame of `houses`."""

import numpy as np

from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.street.houses import FOUNDATION_M


def plain_house(rng: np.random.Generator, width: float, depth: float) -> Builder:
    """A house with piers and bands before a recessed front, a cornice and a roof: about a dozen boxes."""
    part = Builder()
    storeys, storey, recess = int(rng.integers(2, 6)), rng.uniform(2.9, 3.5), rng.uniform(0.2, 0.5)
    top = storeys * storey + 0.3
    part.block((0.0, recess, -FOUNDATION_M), (width, depth, top))
    piers = max(2, round(width / rng.uniform(2.8, 4.5)) + 1)
    thick = rng.uniform(0.5, 1.1)
    for x in np.linspace(0.0, width - thick, piers):
        part.block((x, 0.0, -FOUNDATION_M), (x + thick, recess + 0.02, top))
    for storey_number in range(1, storeys):
        level = storey_number * storey
        part.block((0.01, 0.02, level - 0.4), (width - 0.01, recess + 0.02, level + 0.7))
    part.block((-0.01, -0.22, top - 0.05), (width + 0.01, 0.3, top + 0.18))
    if rng.random() < 0.5:
        part.block((0.0, 0.0, top), (width, 0.28, top + rng.uniform(0.5, 0.9)))
    else:
        ridge = np.array([0.5 * width, 0.5 * depth, top + rng.uniform(0.5, 1.0) * 0.5 * depth])
        for eave in (-0.35, depth + 0.35):
            part.beam(np.array([0.5 * width, eave, top + 0.1]), ridge, width, 0.2)
    return part
