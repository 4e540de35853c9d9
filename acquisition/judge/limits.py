"""Limits of the live judge that are not in `calibration.figures` or LAB.toml, each with its reason.

Quantities that scatter (colour wheel, shutter, lamp) are limited in standard deviations of the measured scatter.
"""

from __future__ import annotations

from typing import Final

from calibration.figures.light import DARK_DRIFT, LEAK_SHARE, OFF_CODES_DEG, WHITE_DRIFT

# Standard deviations with two degrees of freedom: exceeded by chance in one of four million frames.
LIGHT_SIGMAS: Final = 5.5

# Standard deviations of lamp brightness: exceeded in one of 500 million frames. A flickering lamp has longer tails.
BRIGHTNESS_SIGMAS: Final = 6.0

# Standard deviations of light added to two or three frames together. In 2740 frames of 50 undisturbed sessions, light
# above `ADDED_LEAST` stays below 0.9 (`benchmarks.detection`); 1 % in a neutral illuminant is 7.
ADDED_SIGMAS: Final = 4.5

# Standard deviations from which on a frame is compared with the previous illuminant. Few successive illuminants are so
# similar, so that about one frame in 500 is compared.
STALE_SIGMAS: Final = 3.5

# Improvement of the squared distance, in standard deviations, by which the previous illuminant must fit better: a
# factor of 1000 in likelihood.
STALE_ADVANTAGE: Final = 13.8

# The same for any other illuminant of the plan: a factor of 22 000 in likelihood, because there are 706 of them.
OTHER_ADVANTAGE: Final = 20.0

# Light in dark frames, percent of white, at which `build-lut` adds a remark: the user must see it during the night.
ROOM_LIGHT_PERCENT: Final = 100 * LEAK_SHARE.accept

UNEVEN_WHITE: Final = 0.25  # Deviation of a tile, relative, if the camera's own colours replace unknown primaries

UNEVEN_TILES: Final = 0.05  # Share of the tiles that must deviate by it

# Standard deviations of the noise of a tile: none of 384 tiles in 767 frames of 100 sessions exceeds them by chance.
UNEVEN_SIGMAS: Final = 7.0

# Relative deviation of a strip of a row at which it counts as another row. Rows of other patches differ by 6 to 8 % on
# an EOS 550D, by 20 % if strips have few patches, and rows without data by 100 %.
ROW_DEVIATION: Final = 0.15

# Standard deviations of a strip (scatter of the frame, and noise) that a deviating strip must exceed, too.
ROW_SIGMAS: Final = 8.0

# Standard deviation of a photosite, counts, below which noise cannot identify a repeated frame: only rounding remains.
LEAST_NOISE: Final = 0.4

# Light added to several frames, share of white, that is reported as ambient light. Dark frames show less of it, and
# `build-lut` adds a remark at half of this.
ADDED_LEAST: Final = 2 * DARK_DRIFT.accept

ADDED_MOST: Final = 0.1  # Largest light that a room can add, share of white; more is another picture

# Largest step of log lamp brightness (5 %) that is accepted if the repeated frame shows it again. Each illuminant has
# its own ground truth, so that brightness does no harm; a larger step means that the lamp fails.
LAMP_FOLLOWED: Final = 0.055

# Largest change of paper white since the first white frame, percent: beyond it `build-lut` refuses the session.
LAMP_TOTAL: Final = 100 * (WHITE_DRIFT.refuse or 0.0)

# Largest angle between measured and ordered illuminant, degrees, that is accepted if the repeated frame shows it again
# and no other illuminant fits: the projector mixes colours differently than the model. `build-lut` adds a remark above
# it.
LIGHT_FOLLOWED_DEG: Final = OFF_CODES_DEG.accept

# Largest displacement, half-size px, that is accepted if the repeated frame shows the chart at rest there. `build-lut`
# shifts its grid up to this, and adds a remark beyond.
MOVED_FOLLOWED_PX: Final = 1.0

STEADY_PX: Final = 0.1  # Largest difference of two positions, half-size px, of a chart at rest

# Counts of paper above black below which a frame is too dark to measure movement (0.02 px at 66 counts) and blur.
DIM_DN: Final = 40.0

# The same for blur alone, a second derivative of the image: at 420 counts, hot photosites in two of four tags gave 0.4
# px (200 of a million photosites, `benchmarks.detection`).
BLUR_DIM_DN: Final = 500.0

SHARPER: Final = 2.0  # Factor by which a loss of blur may exceed a growth: it harms no sample

# Refusals in a row for one cause that make it a lasting one: the default number of attempts
LASTING_FRAMES: Final = 3

# Angle between the linear codes of two illuminants above which they cannot look alike, if no primaries are known.
NOMINAL_DEG: Final = 8.0
