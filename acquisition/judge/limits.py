"""Limits of the live judge that are not in `calibration.figures` or LAB.toml, each with its reason.

Quantities that scatter (colour wheel, shutter, lamp) are limited in standard deviations of the measured scatter.
"""

from __future__ import annotations

from typing import Final

from calibration.figures.light import DARK_DRIFT, LEAK_SHARE, OFF_CODES_DEG, WHITE_DRIFT

# Deviation of colour, in standard deviations with two degrees of freedom: exceeded in one of four million frames.
LIGHT_SIGMAS: Final = 5.5

# Deviation of lamp brightness, in standard deviations: exceeded in one of 500 million frames of a steady lamp.
BRIGHTNESS_SIGMAS: Final = 6.0

# Light added to two or three frames together, in standard deviations. In 2740 frames of 50 undisturbed sessions, light
# above `ADDED_LEAST` has less than 0.9 (`benchmarks.detection`); added light of 1 % in a neutral illuminant has 7.
ADDED_SIGMAS: Final = 4.5

# Deviation from the ordered illuminant, in standard deviations, from which a frame is compared with the previous
# illuminant. About one correct frame in 500 exceeds it by chance. Few successive illuminants differ by less.
STALE_SIGMAS: Final = 3.5

# Difference of the squared distances, in squared standard deviations, by which the previous illuminant must fit better:
# a factor of 1000 in likelihood.
STALE_ADVANTAGE: Final = 13.8

# The same for any other illuminant of the plan: a factor of 22 000 in likelihood, because there are 706 of them.
OTHER_ADVANTAGE: Final = 20.0

# Light in dark frames, % of white, above which `build-lut` adds a remark. The run warns, while it can be removed.
ROOM_LIGHT_PERCENT: Final = 100 * LEAK_SHARE.accept

UNEVEN_WHITE: Final = 0.25  # Relative deviation of a tile that is allowed if the primaries are unknown

UNEVEN_TILES: Final = 0.05  # Share of the tiles that must deviate by more than `UNEVEN_WHITE` for a rejection

# Deviation of a tile, in standard deviations of its noise: no tile of 384 in 767 frames of 100 sessions exceeds it.
UNEVEN_SIGMAS: Final = 7.0

# Relative deviation of a strip of a row above which it is not the expected row. A row of other patches deviates by 6 to
# 8 % on an EOS 550D, by 20 % if strips have few patches; a row without data by 100 %.
ROW_DEVIATION: Final = 0.15

# The deviation of such a strip must also exceed this number of standard deviations (scatter of the frame, noise).
ROW_SIGMAS: Final = 8.0

# Standard deviation of a photosite, counts, below which noise cannot identify a repeated frame: only rounding remains.
LEAST_NOISE: Final = 0.4

# Light added to several frames, share of white, that is reported as ambient light. Dark frames show less of it, and
# `build-lut` adds a remark at half of this.
ADDED_LEAST: Final = 2 * DARK_DRIFT.accept

ADDED_MOST: Final = 0.1  # Largest light that a room can add, share of white; more is a different projected image

# Largest step of log lamp brightness (5 %) that is accepted if the repeated frame shows it again. Each illuminant has
# its own ground truth, so that brightness does no harm; a larger step means that the lamp fails.
LAMP_FOLLOWED: Final = 0.055

# Largest change of paper white since the first white frame, percent: beyond it `build-lut` refuses the session.
LAMP_TOTAL: Final = 100 * (WHITE_DRIFT.refuse or 0.0)

# Largest angle between measured and ordered illuminant, degrees, that is accepted if the repeated frame shows it again
# and no other illuminant fits: then the projector mixes colours differently from the model. `build-lut` adds a remark
# above this angle.
LIGHT_FOLLOWED_DEG: Final = OFF_CODES_DEG.accept

# Largest displacement, half-size px, that is accepted if the repeated frame shows the chart in the same position.
# `build-lut` shifts its sampling grid; from 0.5 px it registers the frame again and adds a remark.
MOVED_FOLLOWED_PX: Final = 1.0

STEADY_PX: Final = 0.1  # Largest difference of two positions, half-size px, of a chart at rest

# Counts of paper above black below which a frame is too dark to measure movement. The error is 0.02 px at 66 counts.
DIM_DN: Final = 40.0

# The same for blur, which depends on the second derivative of the image. At 420 counts, hot photosites (200 of a
# million) in two of four tags changed the blur by 0.4 px (`benchmarks.detection`).
BLUR_DIM_DN: Final = 500.0

SHARPER: Final = 2.0  # Limit of a decrease of blur, relative to that of an increase: it harms no sample

# Number of successive rejections for the same cause that make it a lasting cause: the default number of attempts.
LASTING_FRAMES: Final = 3

# Angle between the linear codes of two illuminants above which they cannot look alike, if no primaries are known.
NOMINAL_DEG: Final = 8.0
