"""How light falls off towards the edges: of the lens over the frame, of the projector over the page.

Both as the constants that `sim.world.rendering.light` takes: 1 / (1 + c r²)² for the lens, which is cos⁴ of the angle
to its axis, and g / (1 + c d²) for each primary of the projector.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def lens_falloff(axis: tuple[float, float], size: tuple[int, int], lost: float) -> NDArray[np.float64]:
    """Return (3,) float64: x and y of the axis, photosites, and c, for a lens that loses a share at the corner."""
    corner2 = (size[0] ** 2 + size[1] ** 2) / 4
    return np.array([*axis, ((1 - lost) ** -0.5 - 1) / corner2])


def projector_falloff(
    page_mm: tuple[float, float], lost: float, difference: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Return (3, 4) float64: for each primary x and y of its brightest point, mm, c and a gain of 1."""
    page = np.array(page_mm)
    half_diagonal = float(np.hypot(*page)) / 2
    shares = lost * (1 + difference * np.array([-1.0, 0.0, 1.0]))
    aside = np.array([0.05, -0.1]) + difference * random.uniform(-0.5, 0.5, (3, 2))
    spots = page / 2 + half_diagonal * aside
    return np.column_stack([spots, shares / (1 - shares) / half_diagonal**2, np.ones(3)])
