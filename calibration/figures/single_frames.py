"""Limits of what no table shows: the rig before a session, and single frames while it is taken."""

from __future__ import annotations

from typing import Final

from calibration.figures.figure import JUDGEMENT, SIMULATED, Limit

EVENNESS: Final = Limit(
    "evenness", "Light missing at the chart's darkest place, of its brightest", "light", "share", "at most", 0.55, None,
    why="dark corners have too little light for their colours, and the flat field is not known there well enough",
    source=SIMULATED + ": fields whose corners have 42 to 52 % of the centre are divided out to 0.2 %",
    remedy="centre the chart in the projector's picture, stop the lens down, or step back and take a longer lens; turn "
    "the camera by 180°: what turns with it is of the lens",
)  # fmt: skip

TURN: Final = Limit(
    "turn", "Angle between the chart's rows and the picture's", "geometry", "°", "at most", 5.0, None,
    why="the windows of samples lie along the picture's rows, and their corners come near the neighbouring cells",
    source="geometry: 5 px of samples in a cell of 10 px", remedy="turn the camera until the rows are level",
)  # fmt: skip

KEYSTONE: Final = Limit(
    "keystone", "Longer over shorter of two opposite sides of the chart, less 1", "geometry", "share", "at most", 0.1,
    None,
    why="cells are smaller on the far side, and it lies out of the plane of focus", source=JUDGEMENT,
    remedy="set the camera square to the middle of the print: the same distance to all four corners",
)  # fmt: skip

NOISE_REDUCTION: Final = Limit(
    "noise_reduction", "Time after an exposure that grows with it, of the exposure", "noise", "share", "at most", 0.5,
    None,
    why="the body takes a dark frame of its own after each exposure: the session takes twice as long, and frames are "
    "no longer as the sensor gave them",
    source="without it a file's transfer takes as long after any exposure",
    remedy="switch long exposure noise reduction off in the camera's menu",
)  # fmt: skip

DISK: Final = Limit(
    "disk", "Free space over what the plan needs", "devices", "", "at least", 1.0, 1.0,
    why="the run refuses to begin", source="the run's own estimate, retakes and a reserve included",
    remedy="free space, or put the session on another disk (acquire run --dry-run checks the disk of its folder)",
)  # fmt: skip

CARD: Final = Limit(
    "card", "Free space on the camera's card over what the plan needs", "devices", "", "at least", 1.0, 1.0,
    why="the body stops when its card is full", source="the run's own estimate, retakes and a reserve included",
    remedy="put in an empty card",
)  # fmt: skip

BATTERY: Final = Limit(
    "battery", "Frames that the camera's battery holds, over those of the plan", "devices", "", "at least", 1.5, 0.3,
    why="the body switches off when its battery is empty",
    source="440 frames a charge, the least of the paper's cameras (EOS 550D, the maker's figure at 23 °C); a battery "
    "ages, and waiting between frames takes charge, too",
    remedy="use a mains adapter",
)  # fmt: skip

EMPTY_PHOTOSITES: Final = Limit(
    "data", "Photosites without any count", "devices", "share", "at most", 1e-5, 1e-5,
    why="part of the file was lost on its way", source="a body's dead photosites are fewer, one lost row is 3e-4",
    remedy="check the cable and the memory card",
)  # fmt: skip

REPEATED: Final = Limit(
    "repeated", "Noise of the difference to earlier frames, of that of independent ones", "devices", "", "at least",
    0.3, 0.3,
    why="the camera handed out a frame that it had given before",
    source="a correlation of 0.9; the same frame has 0, independent ones 1",
    remedy="check its cable and its memory card",
)  # fmt: skip

UNIFORMITY: Final = Limit(
    "uniformity", "Deviation of the worst tile from the light of the whole frame", "light", "share", "at most", 0.02,
    0.02,
    why="something stands before the chart, or only a part of the picture is the light that was ordered",
    source="an LCD's unevenness changes by as much between codes; a lamp's arc that wanders shifts the field by less",
    remedy="look at the chart and at the picture",
)  # fmt: skip

ROWS: Final = Limit(
    "rows", "Strips of rows that do not show what belongs there", "devices", "", "at most", 3, 3,
    why="the file was damaged on its way, or something covers a part of the picture", source="a fly covers as many",
    remedy="check the cable and the memory card, and look at the picture",
)  # fmt: skip

# What only the live judge measures, besides what LAB.toml limits.
FRAME_LIMITS: Final = (EMPTY_PHOTOSITES, REPEATED, UNIFORMITY, ROWS)

# What only `acquire check` measures.
RIG_LIMITS: Final = (EVENNESS, TURN, KEYSTONE, NOISE_REDUCTION, DISK, CARD, BATTERY)
