"""Where cells are found, channel by channel: `python -m benchmarks.geometry [--rooms N] [--first SEED] [--room NAME]`.

One white frame is taken of the whole chart by either body in each room, registered, and held against the place in which
each channel sees the middle of each cell. One JSON object a line. Rooms, beside the simulated lab's usual waves of 3 mm
over the whole print and its lens's distortion:

- `lateral`: lateral chromatic aberration of 1 px at the corner, red out and blue in;
- `waves`: that, and waves of 150 mm, 6 mm high, and a curl of 25 mm, before a wide-angle lens;
- `tagless`: that of `lateral` on the publication's chart, which has no tags: its field's outline and the small steps of
  its smooth order of colours are all there is;
- `tagless-curl`: that chart with a curl of 25 mm, before a wide-angle lens.

Cells that the registration itself lists as not known well enough, or covered, are not counted, but said. Returns 1 when
a cell that is not listed is more than half a pixel off, or a channel's cells more than 0.04 px RMS. Without tags 0.07 px
are allowed: what the model of a smooth order's colours misses draws all cells by up to 0.005 of their size. A frame that
is refused is no failure, and said. A room takes some 10 s of one core, one without tags 30.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.rooms import Case, PhotographedChart, photographed
from calibration.registration.register import MAX_PLACE_ERROR_PX, Registration, register
from drivers.raw.rawfile import CHANNELS
from experiment.chart.layout import design_chart, paper_chart
from foundation.errors import CropError
from sim.world.world import Room

# RMS distance from the truth that cells may have in a channel (wanted of the suite).
MOST_RMS_PX: Final = 0.04

# The same without tags, in simulated frames: up to 0.06 px at cells of 10 px, 0.045 at those of 8.
MOST_PLAIN_RMS_PX: Final = 0.07

# Distance that a cell may have which is not listed: as far as samples' windows allow for.
MOST_PX: Final = 0.5

# How each room differs from the default one.
ROOMS: Final[Mapping[str, Mapping[str, Any]]] = {
    "lateral": {"lateral_red_px": 1.0, "lateral_blue_px": -1.0},
    "waves": {
        "lateral_red_px": 1.0,
        "lateral_blue_px": -1.0,
        "waviness_mm": 6.0,
        "wave_mm": 150.0,
        "curl_mm": 25.0,
        "focal_diagonals": 0.8,
    },
    "tagless": {"lateral_red_px": 1.0, "lateral_blue_px": -1.0},
    "tagless-curl": {"lateral_red_px": 1.0, "lateral_blue_px": -1.0, "curl_mm": 25.0, "focal_diagonals": 0.8},
}


def listed(shot: PhotographedChart, registration: Registration) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return which cells (C,) a table would list as misplaced or covered."""
    centres, blocks = shot.chart.centres_mm, registration.blocks
    nearest = np.asarray(cKDTree(blocks.centres_mm).query(centres)[1])
    covered = registration.mismatched_cells | ~blocks.good[nearest]
    return covered | (registration.expanded_px(centres) > MAX_PLACE_ERROR_PX)


def tried(name: str, body: str, seed: int) -> dict[str, Any]:
    """Return a line of JSON on where the cells of a frame are found."""
    chart = paper_chart("A0", 5) if name.startswith("tagless") else design_chart(5, seed=seed)
    case = Case(seed, body, "white", replace(Room(seed=seed), **ROOMS[name]))
    shot = photographed(case, chart)
    row: dict[str, Any] = {"room": name, "body": body, "seed": seed}
    try:
        registration = register(shot.mosaic, chart, f"room {name}", shot.corners_px())
    except CropError as error:
        return row | {"refused": str(error), "failed": False}
    fit = ~listed(shot, registration)
    off = np.stack(
        [
            np.linalg.norm(
                registration.to_pixels(chart.centres_mm, channel)
                - (shot.world.project(chart.centres_mm, channel) - shot.crop_offset_px()),
                axis=1,
            )
            for channel in CHANNELS
        ]
    )
    rms = np.sqrt((off[:, fit] ** 2).mean(axis=1))
    worst = off[:, fit].max(axis=1)
    return row | {
        "rms_px": rms.round(4).tolist(),
        "worst_px": worst.round(3).tolist(),
        "rms_of_all_px": np.sqrt((off**2).mean(axis=1)).round(4).tolist(),
        "worst_of_all_px": off.max(axis=1).round(3).tolist(),
        "listed_cells": int((~fit).sum()),
        "failed": bool(rms.max() > (MOST_RMS_PX if chart.tags else MOST_PLAIN_RMS_PX) or worst.max() > MOST_PX),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Try rooms with both bodies, and return 1 if one failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=1, help="how many of each kind")
    parser.add_argument("--first", type=int, default=1, help="the first room's seed")
    parser.add_argument("--room", action="append", choices=list(ROOMS), default=[], help="one kind; all by default")
    given = parser.parse_args(arguments)
    failed = 0
    for name in given.room or list(ROOMS):
        for seed in range(given.first, given.first + given.rooms):
            for body in ("EOS 550D", "EOS 6D Mark II"):
                row = tried(name, body, seed)
                print(json.dumps(row), flush=True)
                failed += row["failed"]
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
