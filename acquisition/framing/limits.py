"""What a picture of the chart must be like to be of use: size, completeness, sharpness, clipping.

Each limit stands once, here; `acquire check` judges a first look by them, `acquire run` each frame, `build-lut` the
session. Pixels are half-size pixels (`acquisition.framing.planes`).
"""

from __future__ import annotations

MIN_MODULE_PX = 3.0
"""Half-size pixels a tag module must have; below, detectors fail one tag after another."""

MIN_TAGS = 2
"""Tags without which no homography is looked for: two give eight points, twice as many as one needs."""

MIN_TAG_SHARE = 0.8
"""Share of the chart's tags that must be found; fewer mean that part of the chart is covered, dark or outside."""

MIN_CELL_PX = 8.0
"""Half-size pixels a cell must have for 25 of them to lie safely inside: 5, rounding and registration, and the blur.
8.6 already bleeds 1 % at σ = 0.7."""

MAX_BLUR_PX = 1.0
"""σ of the print's edges up to which cells of any size are found to a few hundredths of a pixel; beyond it the 25
samples of a cell of 10 px take in more than 1 % of light from its neighbours."""

CLIPPED_SHARE = 0.98
"""Counts above this share of saturation are treated as clipped (judgement: the knee of the response lies above)."""
