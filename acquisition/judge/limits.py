"""How surely frames are judged, besides the limits of `calibration.figures` and of LAB.toml, each with its reason.

What scatters (colour wheel, shutter, lamp) has limits in standard deviations of the scatter that was seen; the numbers
here are how many, and the least that makes sense.
"""

from __future__ import annotations

from typing import Final

from calibration.figures.light import DARK_DRIFT, LEAK_SHARE, OFF_CODES_DEG, WHITE_DRIFT

# Standard deviations of two degrees of freedom: exceeded by chance once in four million frames.
LIGHT_SIGMAS: Final = 5.5

# Standard deviations of the lamp's level: exceeded once in 500 million frames; tails of a flickering lamp are longer.
BRIGHTNESS_SIGMAS: Final = 6.0

# Standard deviations of light added to two or three frames together: in 2740 frames of 50 undisturbed sessions what
# is above `ADDED_LEAST` stays below 0.9 (`benchmarks.detection`), and 1 % in a neutral light is 7.
ADDED_SIGMAS: Final = 4.5

# Standard deviations off from which on the light of the frame before is asked for: few lights are so near to the one
# before, so that one frame in 500 may be asked.
STALE_SIGMAS: Final = 3.5

# By how much squared standard deviations the light before must fit better: a likelihood a thousand times larger.
STALE_ADVANTAGE: Final = 13.8

# The same for any other light of the plan: a likelihood 22 000 times larger, as there are 706 of them.
OTHER_ADVANTAGE: Final = 20.0

# Light under the black picture, of white, from which on `build-lut` remarks on it: a night of it is to be known.
ROOM_LIGHT_PERCENT: Final = 100 * LEAK_SHARE.accept

UNEVEN_WHITE: Final = 0.25  # The same where the primaries are not known and the camera's own colours stand for them

UNEVEN_TILES: Final = 0.05  # Share of the tiles that must deviate by so much there

# Standard deviations of a tile's noise: of 384 tiles in 767 frames of 100 sessions none exceeds them by chance.
UNEVEN_SIGMAS: Final = 7.0

# Deviation of a strip of a row from the light of the frame, relative, that counts it as another row's: rows of other
# cells differ by 6 to 8 % on an EOS 550D, 20 % where strips have few cells, rows that lack data by 100 %.
ROW_DEVIATION: Final = 0.15

# Standard deviations of a strip, of those usual in the frame and of noise, beyond which it counts so, too.
ROW_SIGMAS: Final = 8.0

# Standard deviation of a photosite, counts, below which noise cannot tell a repeated frame: rounding remains.
LEAST_NOISE: Final = 0.4

# Light added to several frames, of white, that is called ambient: build-lut warns of half as much in dark frames,
# which show less of it.
ADDED_LEAST: Final = 2 * DARK_DRIFT.accept

ADDED_MOST: Final = 0.1  # The most that a room's light is taken to add; more is another picture

# Largest step of the lamp that is lived with when the frame is repeated and shows it again (logarithm, 5 %): each
# light has its own ground truth, so that brightness harms none; a larger step is a lamp that fails.
LAMP_FOLLOWED: Final = 0.055

# Largest change of paper white since the session's first white frame, per cent: beyond, build-lut makes no table.
LAMP_TOTAL: Final = 100 * (WHITE_DRIFT.refuse or 0.0)

# Largest angle between the light seen and the one ordered that is lived with when the frame is repeated and shows it
# again, and it is no other light: the projector mixes otherwise than was learnt. build-lut warns from there on.
LIGHT_FOLLOWED_DEG: Final = OFF_CODES_DEG.accept

# Largest displacement that is lived with when the frame is repeated and shows the chart at rest there: build-lut
# moves its grid; beyond, it remarks on it.
MOVED_FOLLOWED_PX: Final = 1.0

STEADY_PX: Final = 0.1  # How near a repeated frame must have the chart for it to be at rest

# Counts of paper above black below which a frame is too dark to tell movement (0.02 px at 66) and blur.
DIM_DN: Final = 40.0

# The same for blur alone, a second derivative of the picture: at 420 counts hot photosites in two of four tags gave
# 0.4 px (200 of a million photosites, `benchmarks.detection`).
BLUR_DIM_DN: Final = 500.0

SHARPER: Final = 2.0  # How many times larger a loss of blur may be than a growth: no sample suffers from it

# Frames refused in a row for one cause that make it a lasting one: as many as a step has attempts by default.
LASTING_FRAMES: Final = 3

# Angle between two lights' codes in linear light from which on they cannot look alike, where no primaries are known.
NOMINAL_DEG: Final = 8.0
