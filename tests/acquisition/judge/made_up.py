"""Frames of a few levels, and the state of the judge after them, without a room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from acquisition.judge.state import Basis, Codes, JudgeState, RecentFrame
from experiment.measures.frame import SEGMENTS, TILE_COLUMNS, TILE_ROWS, FramePlaces, Measured, Noise
from experiment.session.records import TOP

TILES = TILE_ROWS * TILE_COLUMNS
PLACES = FramePlaces(160, 240)
# RGB counts above black of a dark and of a white frame: white adds 2000, 4000 and 2400.
DARK, LIT = (10.0, 12.0, 11.0), (2010.0, 4012.0, 2411.0)
# Counts added by each primary; their sum is white.
PRIMARIES = np.array([[1600.0, 300.0, 40.0], [300.0, 3200.0, 360.0], [100.0, 500.0, 2000.0]])
NOISE = Noise(1.0, 0.1)


def measured(level: npt.ArrayLike, black_measured: bool = True, noise: Noise = NOISE) -> Measured:
    """Return a frame of the same level (3,) or of levels (T, 3) everywhere, counts above black."""
    tiles = np.broadcast_to(np.asarray(level, dtype=np.float64), (TILES, 3)).copy()
    strips = np.broadcast_to(tiles.mean(axis=0), (PLACES.rows * SEGMENTS, 3)).copy()
    samples = np.zeros((0, 2), dtype=np.uint16)
    return Measured(tiles, strips, samples, b"", noise, 0.0, black_measured, 1e4, 0.0, 0.0, 0.0, "", "", PLACES)


def base_state(**changes: object) -> JudgeState:
    """Return the state after a white and a dark frame."""
    dark = measured(DARK)
    return replace(JudgeState(white=measured(LIT), dark=dark, first_dark=dark), **changes)  # pyrefly: ignore[bad-argument-type]


def picture(codes: Codes, gain: npt.ArrayLike = 1.0) -> Measured:
    """Return the frame of codes of a projector of gamma 2.2, its primaries times `gain`."""
    amounts = (np.array(codes) / TOP) ** 2.2 * np.asarray(gain)
    return measured(DARK + amounts @ PRIMARIES)


def started_state(gain: npt.ArrayLike = 1.0, greys: int = 6) -> JudgeState:
    """Return the state after the first frames; white is multiplied by `gain`."""
    dark, white = measured(DARK), picture((255, 255, 255), gain)
    primaries = [(TOP, 0, 0), (0, TOP, 0), (0, 0, TOP)]
    codes = [*primaries, *[(grey, grey, grey) for grey in (TOP, 208, 160, 112, 64, 32)[:greys]]]
    frames = [RecentFrame(code, picture(code), None) for code in codes]
    basis = Basis.from_primaries((frames[0].measured, frames[1].measured, frames[2].measured), dark)
    return base_state(basis=basis, first_frames=(RecentFrame((255, 255, 255), white, None), *frames))
