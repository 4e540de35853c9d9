"""How sharp a chart's picture is: the blur of its tags' and its field's edges, in half-size pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from drivers.raw.rawfile import Plane
from experiment.chart.model import TAG_MODULES
from experiment.framing.field import FoundField
from experiment.framing.finding import FoundTag, Framing

_Points = npt.NDArray[np.float64]

# σ of the print's edges up to which cells of any size are found to a few hundredths of a pixel; beyond it the 25
# samples of a cell of 10 px take in more than 1 % of light from its neighbours.
MAX_BLUR_PX = 1.0

# σ that are tried, half-size px: from less than a photosite's own to far beyond use, 7 % apart.
_BLURS = np.geomspace(0.15, 4, 48)

# Places of the field's outline at which blur is measured: enough for a median that marks in the margin do not move.
_OUTLINE_PLACES = 80

# How much around a place of the field's outline is looked at: one cell, and not the marks in the margin.
_INWARDS_PX, _OUTWARDS_PX, _ALONG_PX = 5.0, 2.5, 3.0


def blur_px(framing: Framing) -> float:
    """Return how soft the picture is: σ of the Gaussian that printed edges have been blurred with, px.

    Median over edges: the tags', or of a chart without tags its field's against the margin. Across a tag's edge lie the
    tag's data, its black border, its white rim and what is beyond, the middle two one module wide: a staircase of four
    unknown levels and known steps, blurred. The σ whose staircase fits the pixels best, each at its own distance from
    the edge, is taken; nothing is interpolated, which would blur as well (a slanted edge, as in ISO 12233). It
    contains what lens, focus and movement do, and the photosites' own size and spacing: 0.29 px for green (two
    photosites half a pixel apart), 0.14 px for red and blue. Good to 0.01 px up to a quarter of a module, beyond that
    read up to a tenth high, as the corners themselves are less sure.
    """
    if framing.field is not None:
        found = _outline_blurs(framing.plane, framing.field)[1]
    else:
        found = np.concatenate([_edge_blurs(framing.plane, tag) for tag in framing.tags])
    return float(np.median(found)) if len(found) else float("nan")


def edge_blurs(framing: Framing) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Return where blur was measured, (N, 2) half-size px, and its σ there, (N,) px, as in `blur_px`.

    One place a tag, with the median of its four edges; of a chart without tags, places along its field's outline.
    """
    if framing.field is not None:
        return _outline_blurs(framing.plane, framing.field)
    seen = [(tag.centre_px, edges) for tag in framing.tags if len(edges := _edge_blurs(framing.plane, tag))]
    places = np.array([place for place, _ in seen], dtype=np.float64).reshape(-1, 2)
    return places, np.array([float(np.median(edges)) for _, edges in seen])


def _edge_blurs(plane: Plane, tag: FoundTag) -> npt.NDArray[np.float64]:
    """Return the σ of each of a tag's four edges; none where the picture ends."""
    module = tag.side_px / TAG_MODULES
    corners = tag.corners_px - plane.offset_px
    left, top = np.floor(corners.min(axis=0) - module).astype(int)
    right, bottom = np.ceil(corners.max(axis=0) + module).astype(int) + 1
    height, width = plane.values.shape
    if left < 0 or top < 0 or right > width or bottom > height:
        return np.empty(0)
    values = plane.values[top:bottom, left:right].ravel().astype(np.float64)
    rows, columns = np.mgrid[top:bottom, left:right]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    found = np.empty(4)
    for edge, (start, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        length = float(np.linalg.norm(end - start))
        tangent = (end - start) / length
        along = (pixels - start) @ tangent / length
        # Corners run clockwise with y down, so this points out of the tag.
        across = (pixels - start) @ np.array([tangent[1], -tangent[0]])
        # Clear of the corners, where another edge is near.
        near = (along > 0.2) & (along < 0.8) & (np.abs(across) < module)
        seen, aside = values[near], across[near]
        found[edge] = _sigma(seen, aside, (-module, 0.0, module))
    return found


def _outline_blurs(plane: Plane, field: FoundField) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Return places all round the field's edge, (N, 2) px, and the edge's σ there; none where the picture ends."""
    height, width = plane.values.shape
    reach = int(np.ceil(_INWARDS_PX + _ALONG_PX))
    found: list[float] = []
    places: list[_Points] = []
    for number in range(0, len(field.outline_px), max(1, len(field.outline_px) // _OUTLINE_PLACES)):
        place, normal = field.outline_px[number] - plane.offset_px, field.normals[number]
        left, top = np.floor(place).astype(int) - reach
        if left < 0 or top < 0 or left + 2 * reach + 2 > width or top + 2 * reach + 2 > height:
            continue
        rows, columns = np.mgrid[top : top + 2 * reach + 2, left : left + 2 * reach + 2]
        pixels = np.column_stack([columns.ravel(), rows.ravel()]) - place
        across = pixels @ normal
        along = pixels @ np.array([-normal[1], normal[0]])
        near = (np.abs(along) < _ALONG_PX) & (across > -_INWARDS_PX) & (across < _OUTWARDS_PX)
        seen = plane.values[top : top + 2 * reach + 2, left : left + 2 * reach + 2].ravel()[near].astype(np.float64)
        found.append(_sigma(seen, across[near], (0.0,)))
        places.append(field.outline_px[number])
    return np.array(places, dtype=np.float64).reshape(-1, 2), np.array(found)


def _sigma(seen: _Points, aside: _Points, steps_at: Sequence[float]) -> float:
    """Return the σ whose blurred staircase fits counts best: steps of unknown height at places across an edge."""
    sigma = _BLURS[:, None]
    steps = [ndtr((aside - at) / sigma) for at in steps_at]
    # The slope of the edge itself takes up what its place is off.
    slope = np.exp(-0.5 * (aside / sigma) ** 2)
    basis = np.linalg.qr(np.stack([np.ones_like(slope), *steps, slope], axis=-1)).Q
    misfit = (seen**2).sum() - ((seen @ basis) ** 2).sum(axis=-1)
    best = int(np.clip(misfit.argmin(), 1, len(_BLURS) - 2))
    before, least, after = misfit[best - 1 : best + 2]
    part = 0.5 * (before - after) / max(before - 2 * least + after, 1e-12)
    return float(_BLURS[best] * (_BLURS[1] / _BLURS[0]) ** float(np.clip(part, -1, 1)))
