"""Whether the whole frame shows one light: nothing covered, no half of another picture, no rows that are not theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.judge import limits
from acquisition.judge.known.basis import Basis, FrameLight, Residuals
from acquisition.judge.known.knowledge import Seen
from acquisition.judge.measured.measuring import SEGMENTS, TILE_COLUMNS, TILE_ROWS, Measured
from experiment.session.records import Check
from foundation.robust import sigma_of

_DARKER = -0.1
"""Median relative deviation below which places that deviate are called covered or dark, and not differently lit."""

_OF_BEFORE = 0.01
"""Power of the deviation, relative, that the light of the frame before may leave where it is seen: 6° off."""

_BOTH_PARTS = 0.5
"""Share of the tiles off from which on it is the frame that deviates and not a part of it."""

_BLURS = (0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""Blurs σ, half-size px, that rows are compared with where they are not what they were."""

_EXPLAINED = 0.4
"""Share of the rows' median deviation that a blur may leave if it is the cause."""

_BLURRED = 0.02
"""Median deviation of rows from which on it is asked for a blur: else it is some rows that deviate, and not all."""

_CONTRAST = 2.0
"""Contrast of the chart at a tile's edges, over the mean of the brighter tile: tags, paper, cells."""

_BY_TURNS = 0.1
"""Share of deviating rows that are brighter, or darker, from which on they are rows of another place."""

_RAGGED = 0.1
"""Median step from row to row, over the median deviation, from which on rows are those of several places: of shadows,
windows and parts of a picture it is 0.03 and less, of scrambled rows 0.2 and more (simulated)."""

_UNSEEN_PX = 1.0
"""Movement or blur, px, that rows at the print's edges must stand: those are measured where they can be told."""

_EDGE = 0.15
"""Relative deviation of a row for each px that the chart lies sideways: cells at a strip's ends are others."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Evenness:
    """The checks, and which tiles (T,) bool deviate, to be drawn."""

    checks: tuple[Check, ...]
    off: npt.NDArray[np.bool_]


def judge_evenness(
    basis: Basis, light: FrameLight, frame: Measured, moved_px: _Array, before: Seen | None = None
) -> Evenness:
    """Return whether a lit frame shows one light everywhere.

    `moved_px`: (2,) how far the chart lies from its place in the basis. `before`: the frame before, whose light may
    still be seen in a part; None where there is none.
    """
    rest = light.tiles
    systematic = limits.UNEVEN if basis.of_primaries else limits.UNEVEN_WHITE
    by = float(np.hypot(*moved_px)) / float(np.diff(frame.places.x_edges).mean())
    # Cells that moved across a tile's edge are others than before, and so is paper that moved over the backdrop.
    systematic = systematic + by * _CONTRAST * _beside(basis)
    allowed = np.maximum(systematic, limits.UNEVEN_SIGMAS * rest.noise)
    excess = np.nan_to_num(rest.relative / allowed, nan=0.0)
    off = excess > 1
    worst = int(excess.argmax())
    # A tile of few cells is not what the camera's colours under white describe; many tiles are.
    least = 1 if basis.of_primaries else max(1, round(limits.UNEVEN_TILES * len(off)))
    late = _share_of_before(basis, light, frame, off, before)
    reason = _uneven_reason(rest, off, late) if off.sum() >= least else ""
    value, limit = (100 * float(np.nan_to_num(number)) for number in (rest.relative[worst], allowed[worst]))
    checks = [Check("uniformity", round(value, 2), None, round(limit, 2), "%", reason)]
    if len(frame.strips):
        checks += _judge_rows(basis, light, frame, moved_px, bool(reason))
    return Evenness(tuple(checks), off if reason else np.zeros_like(off))


def _share_of_before(
    basis: Basis, light: FrameLight, frame: Measured, off: npt.NDArray[np.bool_], before: Seen | None
) -> float:
    """Return for how much of the exposure the tiles off (T,) bool showed the light of the frame before; 0 if another.

    And 0 where that light was so much darker that a shadow explains what is seen as well.
    """
    if before is None or before.amounts is None or not off.any() or not basis.of_primaries:
        return 0.0
    maps = basis.maps[:, off]
    expected, change = (np.einsum("p,ptc->tc", a, maps) for a in (light.amounts, before.amounts - light.amounts))
    seen = frame.tiles[off] - basis.dark[off] - expected
    share, left = _explained(seen, change)
    _, left_by_shadow = _explained(seen, -expected)
    return float(np.median(share)) if left < min(_OF_BEFORE, left_by_shadow / 4) else 0.0


def _explained(seen: _Array, by: _Array) -> tuple[_Array, float]:
    """Return shares (T,) 0 … 1 of what deviates (T, 3) that make up `seen` (T, 3), and the part of its power left.

    Each tile has its own: some are cut by an edge.
    """
    share = np.clip((seen * by).sum(axis=1) / np.maximum((by**2).sum(axis=1), 1e-9), 0, 1)
    left = ((seen - share[:, None] * by) ** 2).sum() / max(float((seen**2).sum()), 1e-9)
    return share, float(left)


def _beside(basis: Basis) -> _Array:
    """Return (T,) float64, ≥ 1: white of the brightest tile beside or at each tile, over its own."""
    from scipy.ndimage import maximum_filter

    strength = np.linalg.norm(basis.maps.sum(axis=0), axis=1).reshape(TILE_ROWS, TILE_COLUMNS)
    return np.asarray(maximum_filter(strength, 3) / np.maximum(strength, 1e-6), dtype=np.float64).ravel()


def _judge_rows(basis: Basis, light: FrameLight, frame: Measured, moved_px: _Array, uneven: bool) -> list[Check]:
    """Return whether rows show what belongs into them, and by how much they are blurred if not."""
    down = float(moved_px[1])
    rest = basis.strips(frame, light.amounts, down)
    if rest is None:
        return []
    wrong = _wrong_rows(basis, rest, moved_px)
    count = int(wrong.sum())
    checks = [Check("rows", float(count), None, float(limits.ROWS))]
    if count <= limits.ROWS:
        return checks
    for sigma in _BLURS:
        soft = basis.strips(frame, light.amounts, down, sigma)
        if soft is not None and _typical(soft) < _EXPLAINED * _typical(rest) and _typical(rest) > _BLURRED:
            reason = (
                f"the frame is out of focus or shaken: its rows are what they were with a blur of {sigma:g} px; was "
                "the focus touched, is autofocus on, or does something shake?"
            )
            return [*checks, Check("blur", sigma, None, None, "px", reason)]
    # Rows of another place are brighter and darker by turns; a shadow or another light is one of both.
    signed = rest.signed[wrong]
    brighter = float((signed > 0).mean())
    if uneven and min(brighter, 1 - brighter) < _BY_TURNS and not _is_ragged(rest, wrong):
        return checks
    rows = np.flatnonzero(wrong.reshape(-1, SEGMENTS).any(axis=1))
    reason = (
        f"{len(rows)} rows of blocks, from row {2 * int(rows[0])} of the frame to {2 * int(rows[-1]) + 1}, do not show "
        "what belongs there; the file was damaged on its way: check the cable and the memory card"
    )
    return [Check("rows", float(count), None, float(limits.ROWS), "", reason)]


def _is_ragged(rest: Residuals, wrong: npt.NDArray[np.bool_]) -> bool:
    """Return whether strips (S,) bool that deviate do so row by row otherwise; a shadow goes on from row to row."""
    deviation, of = np.nan_to_num(rest.signed).reshape(-1, SEGMENTS), wrong.reshape(-1, SEGMENTS)
    both = of[1:] & of[:-1]
    if np.count_nonzero(both) < limits.ROWS:
        return False
    steps = np.abs(np.diff(deviation, axis=0))[both]
    return bool(np.median(steps) > _RAGGED * np.median(np.abs(rest.signed[wrong])))


def _typical(rest: Residuals) -> float:
    return float(np.nanmedian(np.where(np.isfinite(rest.relative), np.abs(rest.signed), np.nan)))


def _wrong_rows(basis: Basis, rest: Residuals, moved_px: _Array) -> npt.NDArray[np.bool_]:
    """Return which strips (S,) bool deviate."""
    seen = np.isfinite(rest.relative)
    if not seen.any():
        return np.zeros(len(seen), dtype=np.bool_)
    usual = max(sigma_of(rest.signed[seen]), 1e-6)
    # A row at the print's edge changes with the least movement.
    assert basis.strip_maps is not None
    strength = np.linalg.norm(basis.strip_maps.sum(axis=0), axis=1).reshape(-1, SEGMENTS)
    steep = np.abs(np.gradient(strength, axis=0)).ravel() / np.maximum(strength.ravel(), 1e-6)
    by = float(np.hypot(*moved_px))
    least = limits.ROW_DEVIATION + _EDGE * by + steep * max(by, _UNSEEN_PX)
    room = np.maximum(least, limits.ROW_SIGMAS * np.maximum(usual, rest.noise))
    return np.asarray(np.abs(np.where(seen, rest.signed, 0.0)) > room)


def _uneven_reason(rest: Residuals, off: npt.NDArray[np.bool_], late: float) -> str:
    lit = np.isfinite(rest.relative)
    share = float(off.sum() / max(int(lit.sum()), 1))
    median = float(np.median(rest.signed[off]))
    where = _where(off)
    amount = f"{max(share, 0.01):.0%} of the frame, {where},"
    if late:
        return (
            f"{amount} still showed the light of the frame before, for {max(late, 0.01):.0%} of the exposure: only a "
            "part of the picture had changed, or a window covers it that has that colour; let it settle for longer "
            "(sequence.settle_s), and look for what else draws on the screen"
        )
    if share > _BOTH_PARTS:
        return (
            f"{share:.0%} of the frame are not what the primaries give together; did the picture change during the "
            "exposure, or does other light fall on the chart?"
        )
    if median < _DARKER:
        return (
            f"{amount} are {-median:.0%} darker than the light of the rest; does somebody or something stand before "
            "the chart or the projector, does a window cover the picture, or did only a part of the picture change?"
        )
    return (
        f"{amount} show another light than the rest, {median:+.0%} bright; did only a part of the picture change, does "
        "a window cover it, or does other light fall there?"
    )


def _where(off: npt.NDArray[np.bool_]) -> str:
    """Return in words where tiles are: "top left", "right", "middle"."""
    rows, columns = np.nonzero(off.reshape(TILE_ROWS, TILE_COLUMNS))
    y, x = (float(np.mean(rows)) + 0.5) / TILE_ROWS, (float(np.mean(columns)) + 0.5) / TILE_COLUMNS
    words = ["top" if y < 0.38 else "bottom" if y > 0.62 else "", "left" if x < 0.38 else "right" if x > 0.62 else ""]
    return " ".join(word for word in words if word) or "in the middle"
