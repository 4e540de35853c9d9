"""What the picture of a chart shows once it is found: how far it has moved, and itself, made small.

Movement is measured in one colour plane on a few gauges, in half-size pixels. A gauge is a tag, or without tags a strip
across the edge between the field of cells and its margin, which is there in every light.

Source: B. D. Lucas and T. Kanade, "An iterative image registration technique", IJCAI 1981.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import CHANNELS, Channel, Mosaic, Plane, channel_offset_px, phases
from experiment.framing.field import FoundField
from experiment.framing.finding import AMBER, FONT, GREEN, RED, FoundTag, Framing
from foundation.robust import huber_weights, robust_sigma

# Half-size px that are measured at most: an edge that moved further has left the crop around its tag or its strip.
MAX_SHIFT_PX = 3.0

# Half-size px that the chart may move before the sampling grid follows: a fifth of the rounding of samples' places.
STILL_PX = 0.1

# Half-size px of movement from which on the chart is registered again: it was knocked, and may have turned too.
REREGISTER_PX = 0.5

_GAUGE_TAGS = 8  # Tags that are measured: the median of eight has an error of 0.005 px where paper has 290 counts

_STEPS = 5  # Gauss-Newton steps at most

_SETTLED_PX = 1e-3  # Step from which on no other is made: a fifth of the error

# Half-size px around a tag that are read: the largest movement, the smoothing, and a turned tag's corners.
_AROUND_TAG_PX = 12

_STRIPS = 32  # Strips spread over the field's outline: eight a side, of which covered ones are outvoted

_STRIP_ALONG, _STRIP_ACROSS = 30, 8  # Half the length and the width of a strip, px

# Half-size px around a strip that are read: the largest movement, the steps' overshoot and cubic interpolation.
_STRIP_REACH_PX = 6

_MIN_STRIPS = 8  # Strips that must be measured for shift, turn and growth to be known twice over

_LEAST_CORRELATION = 0.5  # Of a tag or strip with itself in the earlier frame, for its movement to count (judgement)

# Least eigenvalue of a tag's scaled normal matrix; below, its picture is too plain to measure a movement.
_LEAST_INDEPENDENT = 1e-6

_Points = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shift:
    """How far the chart moved between two frames.

    - `dx`, `dy`: median over the tags measured, or the robust fit of the strips; half-size px, positive when the chart
      lies further right or down.
    - `largest_px`: the largest movement of a tag, or of a corner of the field, so that a rotation shows.
    - `gauges`: tags, or strips, that could be measured; 0 leaves the rest 0 and means unknown.
    - `blur_growth_px2`: how much more blurred the later frame is, the difference of the blurs' variances, half-size
      px²; negative when it is sharper; median. Linear in the difference, so read low from about 1 px² on.
    """

    dx: float
    dy: float
    largest_px: float
    gauges: int
    blur_growth_px2: float = 0.0

    @property
    def length_px(self) -> float:
        """Length of the median movement, half-size px."""
        return float(np.hypot(self.dx, self.dy))


_UNKNOWN = Shift(0.0, 0.0, 0.0, 0)


def gauge_boxes(framing: Framing) -> list[tuple[int, int, int, int]]:
    """Return the parts of a plane that `shift_between` reads, in elements: left, top, right, bottom (exclusive)."""
    if framing.field is None:
        outlines, around = [tag.corners_px for tag in _gauge_tags(framing)], _AROUND_TAG_PX
    else:
        outlines = [places.reshape(-1, 2) for places in _strip_places(*_strips(framing.field))]
        around = _STRIP_REACH_PX
    low = [np.maximum(np.floor(outline.min(axis=0)).astype(int) - around, 0) for outline in outlines]
    high = [np.ceil(outline.max(axis=0)).astype(int) + around for outline in outlines]
    return [(int(a[0]), int(a[1]), int(b[0]), int(b[1])) for a, b in zip(low, high, strict=True)]


def gauges_of(mosaic: Mosaic, channel: Channel, black: npt.NDArray[np.float64], framing: Framing) -> Plane:
    """Return one channel of a frame, float32 counts above black, around its gauges, and 0 elsewhere.

    Movements are measured in nothing else. `black` (2, 2) float64 counts.
    """
    places = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = np.float32(np.mean([black[place] for place in places]))
    values = np.zeros(blocks.shape[2:], dtype=np.float32)
    for left, top, right, bottom in gauge_boxes(framing):
        part = np.s_[top:bottom, left:right]
        values[part] = sum(blocks[place][part].astype(np.float32) for place in places) / np.float32(len(places)) - level
    return Plane(channel, values, channel_offset_px(places))


def shift_between(reference: Plane, framing: Framing, plane: Plane) -> Shift:
    """Return how far the chart has moved, and how much softer it is, in `plane` since `reference`, of the same channel.

    By Lucas and Kanade's method, gain and offset free, up to about 3 px: below that, good to 0.005 px where paper has
    some hundred counts. Costs some milliseconds.
    """
    if framing.field is not None:
        return _field_shift(reference, plane, framing.field)
    shifts = [shift for tag in _gauge_tags(framing) if (shift := _tag_shift(reference, plane, tag)) is not None]
    if not shifts:
        return _UNKNOWN
    table = np.array(shifts)
    median = np.median(table, axis=0)
    largest = float(np.linalg.norm(table[:, :2], axis=1).max())
    return Shift(float(median[0]), float(median[1]), largest, len(shifts), float(median[2]))


def _gauge_tags(framing: Framing) -> list[FoundTag]:
    """Return the tags that the movement is measured on: a few, evenly by number."""
    tags = sorted(framing.tags, key=lambda tag: tag.id)
    last = len(tags) - 1
    return [tags[number] for number in sorted({round(last * part / (_GAUGE_TAGS - 1)) for part in range(_GAUGE_TAGS)})]


def _tag_shift(reference: Plane, plane: Plane, tag: FoundTag) -> _Points | None:
    """Return the movement of one tag and its growth of blur, (3,) px, px, px²; None where it cannot be measured."""
    margin = int(np.ceil(MAX_SHIFT_PX)) + 2
    height, width = reference.values.shape
    corners = tag.corners_px - reference.offset_px
    x0, y0 = np.floor(corners.min(axis=0)).astype(int) - 2
    x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 3
    if x0 < margin or y0 < margin or x1 > width - margin or y1 > height - margin:
        return None
    # Both crops are slightly smoothed, so that the gradient is one of the light and not of the noise.
    crop = np.s_[y0 - margin : y1 + margin, x0 - margin : x1 + margin]
    before = cv2.GaussianBlur(reference.values[crop], (0, 0), 0.7).astype(np.float64)
    after = cv2.GaussianBlur(plane.values[crop], (0, 0), 0.7)
    inner = np.s_[margin:-margin, margin:-margin]
    gy, gx = (np.asarray(gradient)[inner].ravel() for gradient in np.gradient(before))
    template = before[inner].ravel()
    # A little more of Gaussian blur adds half the variance's growth times the Laplacian (the heat equation).
    bend = np.asarray(cv2.Laplacian(before, cv2.CV_64F))[inner].ravel()
    now = template
    rows, columns = np.mgrid[margin : before.shape[0] - margin, margin : before.shape[1] - margin].astype(np.float32)
    design = np.column_stack([template - template.mean(), np.ones_like(template), gx, gy, bend])
    # By the normal equations: a linear-algebra library would start threads beside those that decode frames.
    gram = np.asarray(np.einsum("ni,nj->ij", design, design), dtype=np.float64)
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-9))
    if np.linalg.eigvalsh(gram * scale * scale[:, None])[0] < _LEAST_INDEPENDENT:
        return None
    inverse = np.asarray(np.linalg.inv(gram), dtype=np.float64)
    shift, softer = np.zeros(2), 0.0
    for _ in range(_STEPS):
        moved = cv2.remap(after, columns + np.float32(shift[0]), rows + np.float32(shift[1]), cv2.INTER_CUBIC)
        now = np.asarray(moved, dtype=np.float64).ravel()
        # now = gain · (template + g · step + bend · growth / 2) + offset, linear in the products.
        solution = inverse @ np.asarray(np.einsum("ni,n->i", design, now), dtype=np.float64)
        if solution[0] <= 0:
            return None
        step, softer = solution[2:4] / solution[0], 2 * float(solution[4] / solution[0])
        # The crop read at x + shift shows the tag as it was at x + shift − movement.
        shift -= np.clip(step, -1, 1)
        if np.abs(shift).max() > MAX_SHIFT_PX + 1:
            return None
        if np.abs(step).max() < _SETTLED_PX:
            break
    correlation = np.corrcoef(now, template)[0, 1]
    return np.append(shift, softer) if correlation > _LEAST_CORRELATION else None


def _strips(field: FoundField) -> tuple[_Points, _Points]:
    """Return the middles (K, 2) px of strips spread over the field's outline, and the directions (K, 2) across it."""
    chosen = np.unique(np.linspace(0, len(field.outline_px) - 1, _STRIPS).round().astype(int))
    return field.outline_px[chosen], field.normals[chosen]


def _strip_places(middles: _Points, normals: _Points) -> _Points:
    """Return the places (K, along, across, 2) px of the strips' samples."""
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    u = np.arange(-_STRIP_ALONG, _STRIP_ALONG + 1)[None, :, None, None]
    v = np.arange(-_STRIP_ACROSS, _STRIP_ACROSS + 1)[None, None, :, None]
    return middles[:, None, None] + u * along[:, None, None] + v * normals[:, None, None]


def _field_shift(reference: Plane, plane: Plane, field: FoundField) -> Shift:
    """Return the movement of the field, from how far strips of its outline moved across themselves."""
    middles, normals = _strips(field)
    height, width = reference.values.shape
    places = _strip_places(middles, normals) - reference.offset_px
    room = _STRIP_REACH_PX
    seen_whole = (places >= room) & (places <= np.array([width, height]) - 1 - room)
    inside = np.asarray(seen_whole.all(axis=(1, 2, 3)))
    middles, normals, places = middles[inside], normals[inside], places[inside]
    if len(middles) < _MIN_STRIPS:
        return _UNKNOWN
    before = _sampled(reference, places)
    slope = np.asarray(np.gradient(before, axis=2))
    # As for a tag, but blur along an edge shows nothing.
    bend = np.zeros_like(before)
    bend[:, :, 1:-1] = np.diff(before, 2, axis=2)
    # At a strip's ends there are no neighbours on both sides, whose difference is the slope.
    seen = np.s_[:, :, 1:-1]
    template, slope, bend = (picture[seen].reshape(len(middles), -1) for picture in (before, slope, bend))
    design = np.stack([template, np.ones_like(template), slope, bend], axis=-1)
    gram = np.einsum("kni,knj->kij", design, design) + 1e-9 * np.eye(4)
    moved: _Points = np.zeros(len(middles))
    solution: _Points = np.zeros((len(middles), 4))
    now = template
    for _ in range(_STEPS):
        later = _sampled(plane, places + moved[:, None, None, None] * normals[:, None, None])
        now = later[seen].reshape(len(middles), -1)
        # now = gain · (template + slope · step) + offset, linear in (gain, offset, gain · step).
        found = np.asarray(np.linalg.solve(gram, np.einsum("kni,kn->ki", design, now)[..., None]), dtype=np.float64)
        solution = found[..., 0]
        step = solution[:, 2] / np.maximum(solution[:, 0], 1e-6)
        moved = np.clip(moved - np.clip(step, -1, 1), -MAX_SHIFT_PX - 1, MAX_SHIFT_PX + 1)
        if np.abs(step).max() < _SETTLED_PX:
            break
    centred = [values - values.mean(axis=1, keepdims=True) for values in (template, now)]
    power = np.sqrt((centred[0] ** 2).sum(axis=1) * (centred[1] ** 2).sum(axis=1))
    correlation = (centred[0] * centred[1]).sum(axis=1) / np.maximum(power, 1e-9)
    good = (correlation > _LEAST_CORRELATION) & (np.abs(moved) < MAX_SHIFT_PX)
    if good.sum() < max(_MIN_STRIPS, 0.5 * len(middles)):
        return _UNKNOWN
    left = now - np.einsum("kni,ki->kn", design, solution)
    known = 1 / np.asarray(np.linalg.inv(gram), dtype=np.float64)[:, 2, 2]
    weights = known * solution[:, 0] ** 2 / np.maximum((left**2).mean(axis=1), 1e-9)
    softer = 2 * float(np.median(solution[good, 3] / solution[good, 0]))
    return _similarity(middles[good], normals[good], moved[good], weights[good], field, softer)


def _sampled(plane: Plane, places: _Points) -> _Points:
    """Return a plane's counts, slightly smoothed, at places (K, …, 2) given without its offset."""
    x, y = (np.ascontiguousarray(places[..., axis].reshape(len(places), -1), dtype=np.float32) for axis in (0, 1))
    found = np.asarray(cv2.remap(plane.values, x, y, cv2.INTER_CUBIC), dtype=np.float64).reshape(places.shape[:-1])
    return (np.roll(found, 1, axis=1) + 2 * found + np.roll(found, -1, axis=1)) / 4


def _similarity(
    middles: _Points, normals: _Points, moved: _Points, weights: _Points, field: FoundField, softer: float
) -> Shift:
    """Return the similarity transform of the field (shift, turn, growth) that fits movements (K,) px across strips."""
    centre = field.corners_px.mean(axis=0)
    x, y = ((middles - centre) / np.abs(field.corners_px - centre).max()).T
    # A turn moves (x, y) by (−y, x), a growth by (x, y).
    turn_and_growth = np.stack([normals[:, 1] * x - normals[:, 0] * y, normals[:, 0] * x + normals[:, 1] * y], axis=-1)
    design = np.column_stack([normals, turn_and_growth])
    motion = np.zeros(4)
    trust = np.ones(len(moved))
    for _ in range(4):
        root = np.sqrt(weights * trust)
        motion = np.linalg.lstsq(design * root[:, None], moved * root, rcond=None)[0].astype(np.float64)
        off = np.abs(moved - design @ motion) * np.sqrt(weights)
        scale = robust_sigma(off) + 1e-9
        trust = huber_weights(off, scale)
    dx, dy, turn, growth = motion.tolist()
    corners = (field.corners_px - centre) / np.abs(field.corners_px - centre).max()
    u, v = corners.T
    at_corners = np.stack([dx - turn * v + growth * u, dy + turn * u + growth * v], axis=-1)
    largest = max(float(np.linalg.norm(at_corners, axis=1).max()), float(np.hypot(dx, dy)))
    return Shift(dx, dy, largest, len(moved), softer)


WIDTH_PX = 640  # Longer side of a preview at most, as the journal has it

_QUALITY = 80  # JPEG quality: some 40 kB, 30 MB a session

_LETTER_PX = 7.4  # Width of a letter of the cause at `_SCALE`, px

_SCALE = 0.42  # Size of the letters, of OpenCV's font: the least that is read with ease

_FAINTEST = 0.01  # Share of white to which a dark frame is brightened at most: else its noise would be the picture


def preview_jpeg(
    mosaic: Mosaic,
    black: _Points,
    white: _Points,
    outlines_px: Sequence[_Points],
    boxes: Sequence[tuple[int, int, int, int]],
    cause: str,
) -> bytes:
    """Return a frame as JPEG bytes, at most 640 px wide or high.

    `black`: (2, 2) float64, the frame's black level. `white`: (3,) float64, camera RGB above black that is shown as
    white: paper under full white. `outlines_px`: (K, 2) float64 each, half-size px: outlines of tags, or of the field.
    `boxes`: left, top, right, bottom of parts that deviate, half-size px.
    """
    blocks = mosaic.block_planes()
    height, width = blocks.shape[2:]
    step = -(-max(height, width) // WIDTH_PX)
    of = phases(mosaic)
    small = np.empty((-(-height // step), -(-width // step), 3), dtype=np.float32)
    for number, channel in enumerate(CHANNELS):
        row, column = of[channel][0]
        scale = np.float32(1 / max(float(white[number]), 1.0))
        small[:, :, 2 - number] = (blocks[row, column, ::step, ::step] - np.float32(black[row, column])) * scale
    brightest = max(float(np.percentile(small[::4, ::4].max(axis=2), 99.5)), _FAINTEST)
    image = (np.sqrt(np.clip(small, 0, brightest) / np.float32(brightest)) * 255).astype(np.uint8)
    for corners in outlines_px:
        cv2.polylines(image, [(corners / step).round().astype(np.int32)], True, GREEN, 1, cv2.LINE_AA)
    for box in boxes:
        x0, y0, x1, y1 = (edge // step for edge in box)
        cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), RED, 1)
    if cause:
        image = _written(image, cause)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _written(image: npt.NDArray[np.uint8], cause: str) -> npt.NDArray[np.uint8]:
    # OpenCV's letters are those of ASCII.
    plain = cause.replace("°", " deg").replace("×", "x").replace("–", "-").replace("−", "-").replace("…", "...")
    lines = textwrap.wrap(plain.encode("ascii", "replace").decode(), max(20, int(image.shape[1] / _LETTER_PX)))[:5]
    height, line = len(image), 17
    top = height - line * len(lines) - line // 2
    image[top:] //= 3
    for number, text in enumerate(lines):
        cv2.putText(image, text, (6, top + line * (number + 1)), FONT, _SCALE, AMBER, 1, cv2.LINE_AA)
    return image
