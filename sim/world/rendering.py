"""The two inner loops of the simulated room: from a drawing to the light on every photosite, and from light to counts.

Compiled by numba on first use, single-threaded and without the interpreter's lock; `sim.world.world` calls them for
blocks of rows from as many threads as there are processors. A row's result depends on its own arguments only, so
neither blocks nor threads change a bit of it. Positions are photosites of the visible frame, centres at integers,
unless said.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from foundation.compiled import compiled

GRID_PX = 16
"""Photosites between the nodes of the position grid."""

REACH = 4.0
"""Standard deviations after which the blur's tail (3·10⁻⁵) is dropped."""

_PHI_STEPS = 1024
"""Entries per standard deviation: the error of linear interpolation stays below 2·10⁻⁷."""
_PHI: NDArray[np.float32] = np.array(
    [0.5 * (1 + math.erf((i / _PHI_STEPS) / math.sqrt(2))) for i in range(int(REACH * _PHI_STEPS) + 2)],
    dtype=np.float32,
)


@compiled
def _phi(z: float) -> float:
    """Return the normal distribution's share below z; error < 2·10⁻⁷ within `REACH`, 0 or 1 beyond it."""
    size = abs(z)
    if size >= REACH:
        return 1.0 if z > 0 else 0.0
    scaled = size * _PHI_STEPS
    i = int(scaled)
    share = _PHI[i] + (_PHI[i + 1] - _PHI[i]) * (scaled - i)
    return share if z > 0 else 1.0 - share


@compiled
def _cubic(t: float, weights: NDArray[np.float64]) -> None:
    """Write Lagrange's weights for nodes −1, 0, 1, 2 at 0 ≤ t ≤ 1."""
    weights[0] = -t * (t - 1) * (t - 2) / 6
    weights[1] = (t + 1) * (t - 1) * (t - 2) / 2
    weights[2] = -(t + 1) * t * (t - 2) / 2
    weights[3] = (t + 1) * t * (t - 1) / 6


@compiled
def _reached(lines: NDArray[np.float64], centre: float, reach: float, near: int) -> tuple[int, int]:
    """Return the first and the last interval between lines that `centre` ± `reach` touches, searching from `near`."""
    first = near
    while first > 0 and lines[first - 1] > centre - reach:
        first -= 1
    while first < len(lines) and lines[first] <= centre - reach:
        first += 1
    last = first
    while last < len(lines) and lines[last] < centre + reach:
        last += 1
    return first, last


@compiled
def _alike(labels: NDArray[np.int32], i: int, i1: int, j: int, j1: int) -> bool:
    """Return whether all labels of rows j … j1 and columns i … i1 are the same."""
    for b in range(j, j1 + 1):
        for a in range(i, i1 + 1):
            if labels[b, a] != labels[j, i]:
                return False
    return True


@compiled
def _shares(
    lines: NDArray[np.float64], centre: float, sigma: float, first: int, last: int, out: NDArray[np.float64]
) -> None:
    """Write the share of a normal distribution that falls into each interval from first to last; they add up to 1."""
    before = 0.0
    for k in range(first, last):
        below = _phi((lines[k] - centre) / sigma)
        out[k] = below - before
        before = below
    out[last] = 1.0 - before


@compiled
def light(
    first_row: int,
    nodes: NDArray[np.float64],
    sigma_px: float,
    x_lines: NDArray[np.float64],
    y_lines: NDArray[np.float64],
    labels: NDArray[np.int32],
    signals: NDArray[np.float32],
    channels: NDArray[np.int64],
    vignetting: NDArray[np.float64],
    falloff: NDArray[np.float64],
    response: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write the signal of each photosite of some rows under each primary.

    The blur and the photosite's aperture are one Gaussian, in print coordinates with axes along the print's; the
    drawing is rectangles, so its integral over each is a product of two differences of normal distributions: exact,
    however an edge lies to the photosites.

    `nodes`: (1 or 3, ny, nx, 2) float64, the place on the print in mm, of photosite (16 (i − 1), 16 (j − 1)) at [j, i]:
    one for all camera channels, or one for each. `sigma_px`: blur and aperture, photosites. `x_lines`, `y_lines`: (A,)
    and (B,) float64, every x and every y, ascending, at which the drawing changes, mm. `labels`: (B + 1, A + 1) int32,
    row of `signals` between the lines. `signals`: (n, 3, 3) float32, signal of a colour [label, camera channel,
    primary] in full light, DN. `channels`: (2, 2) int64, camera channel of a photosite by the parity of its row and
    column. `vignetting`: (3,) float64: x, y and c; the lens passes 1 / (1 + c r²)² at r photosites from there.
    `falloff`: (3, 4) float64, for each primary x, y, c and g: the projector gives g / (1 + c d²) at d mm from there.
    `response`: (rows, columns) float32, response of each photosite, about 1. `out`: (3, rows, columns) float32,
    written: signal under each primary, DN.
    """
    rows, columns = out.shape[1], out.shape[2]
    views, node_columns = nodes.shape[0], nodes.shape[2]
    across = np.empty((GRID_PX, 4))
    for k in range(GRID_PX):
        _cubic(k / GRID_PX, across[k])
    down = np.empty(4)
    u_row = np.empty((views, node_columns))
    v_row = np.empty((views, node_columns))
    u_down = np.empty((views, node_columns))
    v_down = np.empty((views, node_columns))
    u_sigmas = np.empty(views)
    v_sigmas = np.empty(views)
    u_share = np.empty(labels.shape[1])
    v_share = np.empty(labels.shape[0])
    for row in range(rows):
        y = first_row + row
        node_y = y // GRID_PX
        _cubic((y - node_y * GRID_PX) / GRID_PX, down)
        for s in range(views):
            for c in range(node_columns):
                u_row[s, c] = (
                    down[0] * nodes[s, node_y, c, 0]
                    + down[1] * nodes[s, node_y + 1, c, 0]
                    + down[2] * nodes[s, node_y + 2, c, 0]
                    + down[3] * nodes[s, node_y + 3, c, 0]
                )
                v_row[s, c] = (
                    down[0] * nodes[s, node_y, c, 1]
                    + down[1] * nodes[s, node_y + 1, c, 1]
                    + down[2] * nodes[s, node_y + 2, c, 1]
                    + down[3] * nodes[s, node_y + 3, c, 1]
                )
                u_down[s, c] = (nodes[s, node_y + 2, c, 0] - nodes[s, node_y + 1, c, 0]) / GRID_PX
                v_down[s, c] = (nodes[s, node_y + 2, c, 1] - nodes[s, node_y + 1, c, 1]) / GRID_PX
        i, j = 0, 0
        for start in range(0, columns, GRID_PX):
            c = start // GRID_PX + 1
            for s in range(views):
                u_across = (u_row[s, c + 1] - u_row[s, c]) / GRID_PX
                v_across = (v_row[s, c + 1] - v_row[s, c]) / GRID_PX
                u_sigmas[s] = sigma_px * math.sqrt(u_across * u_across + u_down[s, c] * u_down[s, c])
                v_sigmas[s] = sigma_px * math.sqrt(v_across * v_across + v_down[s, c] * v_down[s, c])
            for x in range(start, min(start + GRID_PX, columns)):
                w = across[x - start]
                channel = channels[y & 1, x & 1]
                s = channel if views > 1 else 0
                u_sigma, v_sigma = u_sigmas[s], v_sigmas[s]
                u = w[0] * u_row[s, c - 1] + w[1] * u_row[s, c] + w[2] * u_row[s, c + 1] + w[3] * u_row[s, c + 2]
                v = w[0] * v_row[s, c - 1] + w[1] * v_row[s, c] + w[2] * v_row[s, c + 1] + w[3] * v_row[s, c + 2]
                i, i1 = _reached(x_lines, u, REACH * u_sigma, i)
                j, j1 = _reached(y_lines, v, REACH * v_sigma, j)
                label = labels[j, i]
                red, green, blue = signals[label, channel, 0], signals[label, channel, 1], signals[label, channel, 2]
                if not _alike(labels, i, i1, j, j1):
                    _shares(x_lines, u, u_sigma, i, i1, u_share)
                    _shares(y_lines, v, v_sigma, j, j1, v_share)
                    red, green, blue = np.float32(0), np.float32(0), np.float32(0)
                    for b in range(j, j1 + 1):
                        for a in range(i, i1 + 1):
                            share = np.float32(u_share[a] * v_share[b])
                            label = labels[b, a]
                            red += share * signals[label, channel, 0]
                            green += share * signals[label, channel, 1]
                            blue += share * signals[label, channel, 2]
                off_x, off_y = x - vignetting[0], y - vignetting[1]
                passed = 1 / (1 + vignetting[2] * (off_x * off_x + off_y * off_y))
                passed *= passed * response[row, x]
                du, dv = u - falloff[0, 0], v - falloff[0, 1]
                out[0, row, x] = red * passed * falloff[0, 3] / (1 + falloff[0, 2] * (du * du + dv * dv))
                du, dv = u - falloff[1, 0], v - falloff[1, 1]
                out[1, row, x] = green * passed * falloff[1, 3] / (1 + falloff[1, 2] * (du * du + dv * dv))
                du, dv = u - falloff[2, 0], v - falloff[2, 1]
                out[2, row, x] = blue * passed * falloff[2, 3] / (1 + falloff[2, 2] * (du * du + dv * dv))


@compiled
def counts(
    light: NDArray[np.float32],
    weights: NDArray[np.float32],
    noise: NDArray[np.float32],
    left: int,
    black: float,
    read_noise: float,
    gain_e: float,
    saturation: int,
    out: NDArray[np.uint16],
) -> None:
    """Write the counts of some rows of the sensor.

    Shot noise is taken as normal, of variance signal / gain; with the read noise that makes one normal deviate of
    variance signal / gain + read noise²: the photon transfer of EMVA 1288 (release 4.0 linear, section 2.2).

    `light`: (3, rows, visible columns) float32, from `light`; no columns at all for rows of the masked border.
    `weights`: (3,) float32, drive of each primary. `noise`: (rows, sensor columns) float32, standard normal deviates.
    `black`, `read_noise`: mean and standard deviation of a dark count, DN. `gain_e`: electrons per DN. `saturation`:
    largest count. `out`: (rows, sensor columns) uint16, written.
    """
    rows, columns = out.shape
    right = left + light.shape[2]
    top = np.float32(saturation)
    half = np.float32(black + 0.5)
    per_dn = np.float32(1 / gain_e)
    floor = np.float32(read_noise * read_noise)
    dark = np.float32(read_noise)
    red, green, blue = weights[0], weights[1], weights[2]
    nothing = np.float32(0)
    for row in range(rows):
        for x in range(left):
            out[row, x] = np.uint16(min(max(half + dark * noise[row, x], nothing), top))
        for x in range(left, right):
            i = x - left
            signal = red * light[0, row, i] + green * light[1, row, i] + blue * light[2, row, i]
            count = half + signal + math.sqrt(signal * per_dn + floor) * noise[row, x]
            out[row, x] = np.uint16(min(max(count, nothing), top))
        for x in range(right, columns):
            out[row, x] = np.uint16(min(max(half + dark * noise[row, x], nothing), top))
