"""Crops by colour for training batches, each at its own place, scale and mirroring; the rule is `printing.py`'s."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from generator.kernels.choice import check_out, run_in_threads
from generator.kernels.printing import (
    PRINTED_BLOCK,
    PrintedLight,
    PrintedMembers,
    PrintMemory,
    SharedTables,
    at_least_a_block,
    print_segments,
)


@compiled
def _print_crops(
    plan: Any,
    first: int,
    end: int,
    size: Any,
    rest: Any,
    members: Any,
    shares: Any,
    count: Any,
    seeds: Any,
    memory: Any,
    target: int,
    pitches: Any,
    scales: int,
) -> None:
    """Fill crops `first` to `end` - 1; `plan` (N, 9): source, pitch, x, y, flip, means, bases, members from and to."""
    samples, roots, owners = members
    for item in range(first, end):
        source, pitch, x, y, flip, means, bases, begin, stop = plan[item]
        print_segments(
            source,
            pitch,
            (x, y, size[0], size[1]),
            flip != 0,
            (means, bases, rest[0], rest[1], rest[2]),
            (samples[begin:stop], roots[begin:stop], owners[begin:stop]),
            shares,
            False,
            count,
            seeds[item],
            0,
            memory,
            target + item * pitches[0],
            (pitches[1], pitches[2]),
            scales + 28 * item,
            np.float32(0),
        )


def draw_printed_crops(
    samples: npt.NDArray[np.uint16],
    lights: Sequence[PrintedLight],
    pictures: Sequence[npt.NDArray[np.uint8]],
    windows: npt.NDArray[np.int64],
    cells: npt.NDArray[np.uint32],
    *,
    scales: npt.NDArray[np.float32],
    flips: npt.NDArray[np.bool_],
    seeds: npt.NDArray[np.uint64],
    threads: int = 1,
    out: npt.NDArray[np.float32],
) -> npt.NDArray[np.float32]:
    """Return N crops by colour in `out` (N, 3, height, width) float32, 1 = saturation.

    `lights`, `pictures` and `windows` (N, 4: x, y, width, height, inside the picture) are one for each; `scales`
    (N, 7) float32 as of `planar.scales_of`. An InputError says that `out` is of another shape or type.
    """
    width, height = windows[0, 2:].tolist()
    check_out(out, (len(pictures), 3, height, width), np.float32)
    count = len(pictures)
    # Most batches show a light more than once.
    known = {id(light): light for light in lights}
    members, rest = PrintedMembers(samples, list(known.values())), SharedTables(samples, cells)
    of_lights = {
        name: (light.means.ctypes.data, light.bases.ctypes.data, *ends)
        for (name, light), ends in zip(known.items(), pairwise(members.starts.tolist()), strict=True)
    }
    sources = [
        at_least_a_block(picture[y : y + height, x : x + width])
        for picture, (x, y) in zip(pictures, windows[:, :2].tolist(), strict=True)
    ]
    plan = np.empty((count, 9), np.int64)
    plan[:, :2] = [(source.ctypes.data, source.strides[0]) for source in sources]
    plan[:, 2:4], plan[:, 4] = windows[:, :2], flips
    plan[:, 5:] = [of_lights[id(light)] for light in lights]
    whole = width >= PRINTED_BLOCK and out.strides[3] == 4
    work = out if whole else np.empty((count, 3, height, max(width, PRINTED_BLOCK)), np.float32)
    unmasked = np.zeros((1, 1, 1), np.float32)

    def fill(first: int, end: int) -> None:
        memory = PrintMemory(members.most)
        _print_crops(
            plan,
            first,
            end,
            (work.shape[3], height),
            rest.addresses,
            members.arrays,
            unmasked,
            np.uint32(samples.shape[2]),
            seeds,
            memory.arrays,
            work.ctypes.data,
            work.strides[:3],
            scales.ctypes.data,
        )

    run_in_threads(fill, count, threads)
    if not whole:
        for item, flip in enumerate(flips.tolist()):
            out[item] = work[item, :, :, -width:] if flip else work[item, :, :, :width]
    return out
