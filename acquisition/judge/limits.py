"""Limits of the live judge that are not in `calibration.figures` or LAB.toml, each with its reason.

The live judge judges each frame while a session is taken. Quantities that vary from frame to frame because of colour
wheel, shutter or lamp have limits in standard deviations of this scatter. A tile is one of 384 regions of a frame, a
strip a quarter of a row of 2×2 blocks.
"""

from __future__ import annotations

from typing import Final

from calibration.figures.light import DARK_DRIFT, LEAK_SHARE, OFF_CODES_DEG, WHITE_DRIFT

# Largest deviation of colour, in standard deviations with two degrees of freedom. One correct frame in four million
# exceeds it.
LIGHT_SIGMAS: Final = 5.5

# Largest deviation of lamp brightness, in standard deviations. One frame in 500 million of a steady lamp exceeds it.
BRIGHTNESS_SIGMAS: Final = 6.0

# Least light added to two or three frames together, in standard deviations, that is reported. In undisturbed sessions,
# light above `MIN_ADDED_LIGHT` was less than 0.9 standard deviations (`benchmarks.detection`).
ADDED_SIGMAS: Final = 4.5

# Deviation of colour, in standard deviations, from which a frame is compared with the previous illuminant. About one
# correct frame in 500 exceeds it by chance.
STALE_SIGMAS: Final = 3.5

# The previous illuminant is reported if its squared distance is smaller than that of the ordered one by this number
# of squared standard deviations. This is a factor of 1000 in likelihood.
STALE_ADVANTAGE: Final = 13.8

# The same number for any other illuminant. The factor is 22 000, because the plan has hundreds of illuminants.
OTHER_ADVANTAGE: Final = 20.0

# Light in dark frames, percent of white, above which a run warns, because `build-lut` would add a remark.
ROOM_LIGHT_PERCENT: Final = 100 * LEAK_SHARE.accept

UNEVEN_WITHOUT_PRIMARIES: Final = 0.25  # Largest relative deviation of a tile if there are no frames of the primaries.

# Share of the tiles that must deviate by more than `UNEVEN_WITHOUT_PRIMARIES` for a refusal.
UNEVEN_TILES: Final = 0.05

# Largest deviation of a tile, in standard deviations of its noise. No tile exceeded it in 100 undisturbed sessions.
UNEVEN_SIGMAS: Final = 7.0

# Relative deviation of a strip above which it is not the expected row. A row without data deviates by 100 %, a row of
# other patches by 6 to 20 %.
ROW_DEVIATION: Final = 0.15

# The deviation of such a strip must also exceed this number of standard deviations (scatter of the frame, noise).
ROW_SIGMAS: Final = 8.0

# Least standard deviation of a photosite, counts, at which noise can identify a repeated frame. Smaller noise is lost
# by rounding.
MIN_NOISE_DN: Final = 0.4

# Least light added to several frames, share of white, that is reported as ambient light. `build-lut` adds a remark at
# half of this.
MIN_ADDED_LIGHT: Final = 2 * DARK_DRIFT.accept

# Largest added light, share of white, that is reported as ambient light. More is a different projected image.
MAX_ADDED_LIGHT: Final = 0.1

# Largest step of log lamp brightness (5 %) that is accepted if the repeated frame shows it again. Each illuminant has
# its own ground truth, so a step does no harm. A larger step indicates a failing lamp.
LAMP_STEP_ACCEPTED: Final = 0.055

# Largest change of white paper since the first white frame, percent. With more, `build-lut` refuses the session.
MAX_WHITE_DRIFT: Final = 100 * (WHITE_DRIFT.refuse or 0.0)

# Largest angle between measured and ordered illuminant, degrees, that is accepted if the repeated frame shows it again
# and no other illuminant fits. The projector then mixes colours differently from the model. `build-lut` adds a remark
# above this angle.
ANGLE_ACCEPTED_DEG: Final = OFF_CODES_DEG.accept

# Largest displacement of the chart, half-size px, that is accepted if the repeated frame shows the same position.
# `build-lut` corrects it.
MOVEMENT_ACCEPTED_PX: Final = 1.0

SAME_POSITION_PX: Final = 0.1  # Largest distance of two measured positions, half-size px, of a chart at rest.

# Least counts of paper above black at which movement is measured. The error is 0.02 px at 66 counts.
MIN_PAPER_DN: Final = 40.0

# Least counts of paper for blur. Blur depends on the second derivative of the image. In dim frames, hot photosites
# disturb it.
MIN_PAPER_FOR_BLUR_DN: Final = 500.0

# Blur may decrease by this multiple of its allowed increase, because less blur is harmless.
SHARPENING_RATIO: Final = 2.0

# Number of successive refusals for the same cause after which the cause counts as lasting. It is the default number of
# attempts.
LASTING_FRAMES: Final = 3

# Angle between the linear codes of two illuminants above which their frames must differ. It is used without frames of
# the primaries.
DISTINCT_CODES_DEG: Final = 8.0
