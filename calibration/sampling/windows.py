"""How large a window of samples a cell allows: the light of neighbouring cells that the lens's blur mixes in."""

from __future__ import annotations

from experiment.limits.bleed import bleed

WINDOWS = (3, 5, 7, 9)
"""Sides of windows, half-size px: odd, so that a cell has a middle pixel; a cell is about 10 px wide."""

SAFE_BLEED = 0.002
"""Share of a sample's light from beyond its cell that counts as none: less than half of what the verdict remarks on."""


def largest_window(cell_px: float, blur_px: float) -> int:
    """Return the largest of `WINDOWS` in which no sample exceeds `SAFE_BLEED`; 0 if there is none.

    5 on the EOS 550D and 7 on the 6D Mark II, whose cells have 10.2 and 12.4 px, at a blur of σ = 0.7 px.

    `cell_px`: shorter side of a cell, half-size px. `blur_px`: σ of the blur, half-size px.
    """
    return max((window for window in WINDOWS if bleed(cell_px, blur_px, window) <= SAFE_BLEED), default=0)
