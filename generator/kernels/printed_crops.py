"""Draw training crops rendered by colour: windows as float32 planes; `printing.py` has the formula."""

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
    padded_to_block,
    print_segments,
)


@compiled
def _print_crops(
    plan: Any,
    first: int,
    end: int,
    size: Any,
    shared_addresses: Any,
    members: Any,
    shares: Any,
    count: Any,
    seeds: Any,
    memory: Any,
    target: int,
    pitches: Any,
    scales: int,
) -> None:
    # Columns of `plan` (N, 9) int64: address and row pitch of the window, x, y, flip, addresses of means and bases, and
    # the range (first, end) of the crop in `PrintedMembers`.
    member_samples, roots, owners = members
    for item in range(first, end):
        source, pitch, x, y, flip, means, bases, begin, stop = plan[item]
        print_segments(
            source,
            pitch,
            (x, y, size[0], size[1]),
            flip != 0,
            (means, bases, shared_addresses[0], shared_addresses[1], shared_addresses[2]),
            (member_samples[begin:stop], roots[begin:stop], owners[begin:stop]),
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
    """Fill `out` (N, 3, height, width) float32 with N crops rendered by colour, 1 = saturation; return it.

    `lights`, `pictures` and `windows` (N, 4) have one entry per crop. A window is x, y, width and height inside the
    picture; all have the same size. `scales` (N, 7) float32 is from `planar.scales_of`. An InputError is raised if
    `out` has another shape or type.
    """
    width, height = windows[0, 2:].tolist()
    check_out(out, (len(pictures), 3, height, width), np.float32)
    count = len(pictures)
    # A batch often contains an illuminant several times; it is prepared once.
    distinct_lights = {id(light): light for light in lights}
    members, shared = PrintedMembers(samples, list(distinct_lights.values())), SharedTables(samples, cells)
    light_columns = {
        identity: (light.means.ctypes.data, light.bases.ctypes.data, *ends)
        for (identity, light), ends in zip(distinct_lights.items(), pairwise(members.starts.tolist()), strict=True)
    }
    sources = [
        padded_to_block(picture[y : y + height, x : x + width])
        for picture, (x, y) in zip(pictures, windows[:, :2].tolist(), strict=True)
    ]
    plan = np.empty((count, 9), np.int64)
    plan[:, :2] = [(source.ctypes.data, source.strides[0]) for source in sources]
    plan[:, 2:4], plan[:, 4] = windows[:, :2], flips
    plan[:, 5:] = [light_columns[id(light)] for light in lights]
    fills_out_directly = width >= PRINTED_BLOCK and out.strides[3] == 4
    work = out if fills_out_directly else np.empty((count, 3, height, max(width, PRINTED_BLOCK)), np.float32)
    no_shares = np.zeros((1, 1, 1), np.float32)

    def fill(first: int, end: int) -> None:
        memory = PrintMemory(members.largest_size)
        _print_crops(
            plan,
            first,
            end,
            (work.shape[3], height),
            shared.addresses,
            members.arrays,
            no_shares,
            np.uint32(samples.shape[2]),
            seeds,
            memory.arrays,
            work.ctypes.data,
            work.strides[:3],
            scales.ctypes.data,
        )

    run_in_threads(fill, count, threads)
    if not fills_out_directly:
        for item, flip in enumerate(flips.tolist()):
            out[item] = work[item, :, :, -width:] if flip else work[item, :, :, :width]
    return out
