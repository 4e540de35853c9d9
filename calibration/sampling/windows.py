"""How large a window of samples a cell allows: the light of neighbouring cells that the lens's blur mixes in.

What a Gaussian blur mixes into a cell's samples, and from which blur on a frame is refused.

The one rule of `acquire check`, of the registration and of a table's verdict. Half-size pixels.
"""

from __future__ import annotations

from experiment.framing.sharpness import MAX_BLUR_PX

WINDOW_PX = 5
"""Pixels along the side of a cell's window, where the user names no other: the paper's (section 3.2)."""

MISPLACEMENT_PX = 0.75
"""How far a sample may lie from its place: 0.5 px of rounding and 0.25 px of registration."""

SAMPLE_REACH_PX = 3.25
"""From a cell's true centre to the outer edge of its 25 pixels: 2.5, rounding 0.5, registration 0.25."""

_LEAST_BLUR_PX = 1e-3
"""Keeps a perfectly sharp picture from dividing by 0."""


def bleed(cell_px: float, blur_px: float, window: int = WINDOW_PX) -> float:
    """Return the share, 0 … 1, of the worst sample's light that comes from beyond its cell.

    The normal integral (a Gaussian of σ `blur_px`) beyond the cell's nearest edge, for the outermost of `window` pixels
    (2 px from the middle one of 5), misplaced by `MISPLACEMENT_PX` towards that edge.

    `cell_px`: shorter side of a cell, half-size px. `blur_px`: σ of the blur, half-size px.
    """
    from scipy.special import ndtr

    return float(ndtr(-(cell_px / 2 - window // 2 - MISPLACEMENT_PX) / max(blur_px, _LEAST_BLUR_PX)))


def blur_of_bleed(cell_px: float, share: float, window: int = WINDOW_PX) -> float:
    """Return the σ of the blur, half-size px, at which `bleed` is `share` (0 … 0.5); 0 where it is at any blur."""
    from scipy.special import ndtri

    return max(cell_px / 2 - window // 2 - MISPLACEMENT_PX, 0.0) / -float(ndtri(share))


def largest_blur_px(cell_px: float) -> float:
    """Return the σ of the blur, half-size px, up to which a chart with cells of so many px is registered.

    Up to `MAX_BLUR_PX` cells of any size are found to a few hundredths of a pixel. What such a blur mixes into their
    samples depends on the cells' size; the verdict judges it as bleed.
    """
    return max(MAX_BLUR_PX, (cell_px / 2 - SAMPLE_REACH_PX) / 2)


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
