"""Limits for the laboratory before a session, and for single frames during it. A LUT is not judged by them."""

from __future__ import annotations

from typing import Final

from calibration.figures.figure import JUDGEMENT, SIMULATED, Limit

EVENNESS: Final = Limit(
    "evenness", "Light missing at the chart's darkest position, relative to the brightest", "light", "share",
    "at most", 0.55, None,
    why="dark corners lack light for dark colours, and the flat field is uncertain there",
    source=SIMULATED + ": the flat field has an error of 0.2 % if the corners get 42 to 52 % of the central light",
    remedy="centre the chart in the projected image, stop the lens down, or step back and use a longer lens; to find "
    "the origin, turn the camera by 180°: a pattern that turns with the camera comes from the lens",
)  # fmt: skip

TURN: Final = Limit(
    "turn", "Angle between the rows of the chart and of the frame", "geometry", "°", "at most", 5.0, None,
    why="sampling windows are aligned with the rows of the frame, so that their corners approach neighbouring patches",
    source="calculated for a window of 5 px in a patch of 10 px", remedy="turn the camera until the rows are parallel",
)  # fmt: skip

KEYSTONE: Final = Limit(
    "keystone", "Ratio of two opposite sides of the chart, minus 1", "geometry", "share", "at most", 0.1, None,
    why="patches on the far side are smaller and out of focus", source=JUDGEMENT,
    remedy="align the camera perpendicular to the print, at the same distance from all four corners",
)  # fmt: skip

NOISE_REDUCTION: Final = Limit(
    "noise_reduction", "Extra time after an exposure, relative to the exposure", "noise", "share", "at most", 0.5, None,
    why="the camera takes its own dark frame after each exposure: the session takes twice as long, and raw data are "
    "altered", source="without noise reduction, the time after an exposure does not depend on its length",
    remedy="switch long exposure noise reduction off in the camera's menu",
)  # fmt: skip

DISK: Final = Limit(
    "disk", "Free disk space, relative to the space for all planned frames", "devices", "", "at least", 1.0, 1.0,
    why="the run refuses to start", source="estimate of the run, including retakes and a reserve",
    remedy="free space, or put the session on another disk (acquire run --dry-run checks the disk of its folder)",
)  # fmt: skip

CARD: Final = Limit(
    "card", "Free space on the camera's card, relative to the space for all planned frames", "devices", "",
    "at least", 1.0, 1.0,
    why="the body stops when its card is full", source="estimate of the run, including retakes and a reserve",
    remedy="insert an empty card",
)  # fmt: skip

BATTERY: Final = Limit(
    "battery", "Frames per battery charge, relative to the number of planned frames", "devices", "", "at least", 1.5,
    0.3,
    why="the body switches off when its battery is empty",
    source="440 frames per charge are assumed (EOS 550D at 23 °C, manufacturer's value); fewer if the battery is old",
    remedy="use a mains adapter",
)  # fmt: skip

EMPTY_PHOTOSITES: Final = Limit(
    "data", "Photosites without counts", "devices", "share", "at most", 1e-5, 1e-5,
    why="part of the file was lost during transfer",
    source="a sensor has fewer dead photosites, and one lost row is 0.03 %",
    remedy="check the cable and the memory card",
)  # fmt: skip

REPEATED: Final = Limit(
    "repeated", "Noise that is independent of earlier frames, relative to all noise", "devices", "",
    "at least", 0.3, 0.3,
    why="the camera delivered an earlier frame again",
    source="an identical frame has 0, and an independent frame has 1; 0.3 is a correlation of 0.95",
    remedy="check the camera's cable and memory card",
)  # fmt: skip

UNIFORMITY: Final = Limit(
    "uniformity", "Deviation of the brightness of one part of the frame from the whole frame", "light", "share",
    "at most", 0.02, 0.02,
    why="an object is in front of the chart, or only part of the projected image shows the planned illuminant",
    source="the uniformity of an LCD changes by up to 2 % between codes",
    remedy="check the chart and the projected image",
)  # fmt: skip

ROWS: Final = Limit(
    "rows", "Strips (quarters of rows of pixels) with unexpected content", "devices", "", "at most", 3, 3,
    why="the file was damaged during transfer, or an object covers part of the frame",
    source="an insect in front of the chart covers three strips",
    remedy="check the cable, the memory card and the frame",
)  # fmt: skip

# Limits for each frame while a session is taken, in addition to the limits in LAB.toml.
FRAME_LIMITS: Final = (EMPTY_PHOTOSITES, REPEATED, UNIFORMITY, ROWS)

# Limits that only `acquire check` measures, before a session.
RIG_LIMITS: Final = (EVENNESS, TURN, KEYSTONE, NOISE_REDUCTION, DISK, CARD, BATTERY)
