"""Whether a frame shows the light that was ordered, and shows it everywhere.

The amounts of the three primaries in a frame are compared with those predicted from the codes. The lamp's level is left
free for the colour, and judged by itself. A light that is not the one ordered is held against everything else that it
could be: the light of the frame before, another one of the plan, the ordered one and light from elsewhere.
Tiles and rows that show another light than the whole frame are covered, half of another picture, or damaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from acquisition.judge import limits
from acquisition.judge.light import Basis, Codes, Fit, FrameLight, Prediction, ProjectorModel, Residuals
from acquisition.judge.measure import SEGMENTS, TILE_COLUMNS, TILE_ROWS, Measured
from acquisition.judge.state import JudgeState, LampSeen, Leaning, Seen, combined
from experiment.session.records import Check, SessionStep
from foundation.colorimetry import angles_deg, decode_srgb
from foundation.robust import sigma_of

_SAME_SD = 0.0015
"""Scatter of amounts between two frames of one light that is reckoned with at least, relative."""

_SAME_FLOOR = 4e-4
"""The same of amounts without light, of a full primary."""

_NEAREST = 12
"""Lights of the plan that are compared in full with one that is not the one ordered."""

_PRIMARIES = ("red", "green", "blue")

_ASKED_LEAST = 0.005
"""Light of a primary, of its full light, from which on it can be missed."""

_GONE = 0.05
"""Share of the ordered light of a primary below which it is missing: a leak of black is less."""

_Array = npt.NDArray[np.float64]


def judge_light(
    state: JudgeState,
    step: SessionStep,
    light: FrameLight,
    plan: Sequence[Codes],
    angle_deg: float,
    drift_percent: float,
) -> tuple[tuple[Check, ...], LampSeen]:
    """Return whether a lit frame shows what its step asks for, and what it shows of the lamp."""
    codes = step.colour.codes
    before = state.recent[-1] if state.recent else None
    if not state.modelled:
        return (_without_model(light, codes, before),), LampSeen()
    seen = _SeenLight(state.model, light, codes, before, plan)
    fit = seen.fit
    limit = max(angle_deg, fit.angle_limit(limits.LIGHT_SIGMAS))
    room = max(drift_percent / 100, limits.BRIGHTNESS_SIGMAS * fit.brightness_sd)
    wrong = fit.angle_deg > limit
    reason, added = "", 0.0
    if wrong or fit.distance > limits.STALE_SIGMAS or abs(fit.brightness) > room:
        reason, added = seen.cause(wrong, room, again=state.refused[0] == "light")
    stepped = False
    lamp = ""
    if not reason and abs(fit.brightness) > room:
        level = state.candidate[0]
        # Shown twice alike, and small: the lamp has another level now, and each light has a ground truth of its own.
        stepped = abs(fit.brightness) <= limits.LAMP_FOLLOWED and abs(fit.brightness - level) <= room / 2
        lamp = "" if stepped else _brightness_reason(fit.brightness)
    leaning = Leaning(((fit.brightness, fit.brightness_sd),), (seen.neutral_light(),))
    if not reason and not lamp and not stepped and not state.rested:
        lamp, added = crept(state.leaning.then(leaning), drift_percent / 100)
        reason = _ambient_reason(added) if added else ""
    ambient = (Check("ambient", round(100 * added, 2), None, None, "%", reason),) if added else ()
    # Where another cause changes the light, its brightness is none of the lamp's.
    checks = (
        *ambient,
        Check("light", round(fit.angle_deg, 3), None, round(limit, 3), "°", "" if added else reason),
        lamp_check(fit.brightness, room, lamp),
    )
    return checks, LampSeen(fit.brightness, stepped, leaning)


def lamp_check(brightness: float, room: float, reason: str) -> Check:
    """Return a frame's brightness against the one foretold, as logarithms, and how far it may be off.

    No limits are stated where the first frames do not yet tell how the lamp scatters: they would allow what no session
    may have.
    """
    allowed = round(100 * room, 2) if 100 * room < limits.LAMP_TOTAL else None
    low = None if allowed is None else -allowed
    return Check("lamp", round(100 * float(np.expm1(brightness)), 2), low, allowed, "%", reason)


def crept(leaning: Leaning, drift: float) -> tuple[str, float]:
    """Return the reason against the lamp, or how much light is added, of white, that the last lights together show.

    `drift`: change of brightness that is always allowed, 0 … 1.
    """
    for count in range(2, len(leaning.lamp) + 1):
        added, sd = combined(leaning.added[:count])
        if added > max(limits.ADDED_LEAST, limits.ADDED_SIGMAS * sd):
            return "", added
        brightness, sd = combined(leaning.lamp[:count])
        if abs(brightness) > max(drift, limits.BRIGHTNESS_SIGMAS * sd):
            return _brightness_reason(brightness), 0.0
    return "", 0.0


def same_light(one: _Array, other: _Array, scatter: float) -> float:
    """Return how many standard deviations two frames' amounts (3,) differ by; `scatter` relative, of colours."""
    sd = max(scatter, _SAME_SD)
    variance = 2 * ((sd * np.maximum(one, other)) ** 2 + _SAME_FLOOR**2)
    return float(np.sqrt(((one - other) ** 2 / variance).sum()))


@dataclass(frozen=True, eq=False)
class _SeenLight:
    """The light of a frame, held against the one that was ordered by `codes`, and against what else it may be.

    - `before`: the frame before; None where there is none.
    - `plan`: codes of all lights that may be shown.
    """

    model: ProjectorModel
    light: FrameLight
    codes: Codes
    before: Seen | None
    plan: Sequence[Codes]

    @cached_property
    def expected(self) -> Prediction:
        """The amounts that were ordered."""
        return self.model.predict(self.codes)

    @cached_property
    def fit(self) -> Fit:
        """How well the light agrees with the one ordered."""
        return self.model.compare(self.light.amounts, self.codes, self.light.covariance)

    def cause(self, wrong: bool, room: float, *, again: bool) -> tuple[str, float]:
        """Return why it is not the one ordered, empty where it is but its lamp, and how much light is added to it.

        `wrong`: whether its colour is off by more than its limit. `room`: change of the lamp's level that is allowed.
        `again`: whether the frame before was refused for its light, too.
        """
        fit = self.fit
        squared = fit.distance**2 + (fit.brightness / fit.brightness_sd) ** 2
        same = self._off_before()
        changed = self.before is not None and self.before.codes != self.codes
        fits_before = same < limits.LIGHT_SIGMAS and squared - same**2 > limits.STALE_ADVANTAGE
        if self.before is not None and changed and fits_before:
            return _stale_reason(self.before, self.codes), 0.0
        missing = self._missing()
        if missing:
            return missing, 0.0
        remains, ambient = self._added_of(self.before), self._added_of(None)
        if wrong and remains is not None and (ambient is None or remains[1] + 9 < ambient[1]):
            elsewhere = ", or does light from elsewhere fall on the chart?" if self._coloured() else ""
            return (
                f"{100 * remains[0]:.1f} % of the light of the frame before remain in this one; let the picture settle "
                f"for longer (sequence.settle_s), and switch dynamic contrast and frame interpolation off{elsewhere}",
                0.0,
            )
        if wrong:
            if ambient is not None:
                return _ambient_reason(ambient[0]), ambient[0]
            other = self._other(squared)
            coloured = 0.0 if other else self._coloured()
            if coloured:
                return _ambient_reason(coloured), coloured
            repeated = again and not changed and same < limits.LIGHT_SIGMAS
            if repeated and not other and fit.angle_deg <= limits.LIGHT_FOLLOWED_DEG:
                return "", 0.0
            return other or self._wrong_reason(), 0.0
        if fit.brightness > room and ambient is not None and ambient[1] + 9 < fit.distance**2:
            return _ambient_reason(ambient[0]), ambient[0]
        if fit.distance > limits.STALE_SIGMAS:
            return self._other(squared), 0.0
        return "", 0.0

    def neutral_light(self) -> tuple[float, float]:
        """Return how much neutral light, of white, is added to the one ordered, and its standard deviation."""
        h, neutral = self.expected.amounts, np.ones(3)
        scatter = self.model.brightness_sd**2 * np.outer(h, h)
        weight = np.linalg.inv(self.expected.with_lamp + self.light.covariance + scatter)
        power = float(neutral @ weight @ neutral)
        return float(neutral @ weight @ (self.light.amounts - h)) / power, power**-0.5

    def _off_before(self) -> float:
        """Return by how many standard deviations the light of the frame before is another; infinite if not known."""
        if self.before is None or self.before.amounts is None:
            return np.inf
        return same_light(self.light.amounts, self.before.amounts, self.model.chroma_sd)

    def _missing(self) -> str:
        """Return the sentence that names primaries without light, where the others are as ordered; empty if none."""
        seen, wanted = self.light.amounts, self.expected.amounts
        sd = np.sqrt(
            np.diag(self.expected.with_lamp + self.light.covariance) + (self.model.brightness_sd * wanted) ** 2
        )
        asked = wanted > np.maximum(_ASKED_LEAST, limits.LIGHT_SIGMAS * sd)
        gone = asked & (seen < _GONE * wanted)
        if (
            not gone.any()
            or (np.abs(seen - wanted) > limits.LIGHT_SIGMAS * sd)[~gone].any()
            or not (asked & ~gone).any()
        ):
            return ""
        names = " and ".join(name for name, lost in zip(_PRIMARIES, gone, strict=True) if lost)
        return (
            f"no {names} comes through, the rest is as ordered ({self._parts()} of the primaries); does the "
            f"projector's {names} fail, its lamp, panel or filter, is the picture's cable damaged, or does a picture "
            "mode leave it out?"
        )

    def _parts(self) -> str:
        numbers = zip(_PRIMARIES, self.light.amounts, self.expected.amounts, strict=True)
        return ", ".join(
            f"{name} {100 * max(seen, 0.0):.1f} % instead of {100 * wanted:.1f} %" for name, seen, wanted in numbers
        )

    def _wrong_reason(self) -> str:
        darker = bool((self.light.amounts < self.expected.amounts).all())
        why = "its brightness or contrast was changed or power is saved, or " if darker else ""
        return (
            f"the light is not the one ordered, {_named(self.codes)}: {self._parts()} of the primaries; see whether "
            f"{why}something covers the picture or changes its colours, a pop-up, a screen saver, a picture mode"
        )

    def _other(self, squared: float) -> str:
        """Return the sentence that names the light of the plan, or black or white, that is seen; empty if none."""
        # Only what is about as bright and of that colour is compared in full.
        found: tuple[float, Codes] | None = None
        for other in self._near([*self.plan, (0, 0, 0), (255, 255, 255)]):
            if other == self.codes:
                continue
            if not any(other):
                left = float(((self.light.amounts / (3 * _SAME_FLOOR)) ** 2).sum())
            else:
                fit = self.model.compare(self.light.amounts, other, self.light.covariance)
                left = fit.distance**2 + (fit.brightness / (fit.brightness_sd + 0.01)) ** 2
            if found is None or left < found[0]:
                found = left, other
        if found is None or squared - found[0] < limits.OTHER_ADVANTAGE or found[0] > limits.LIGHT_SIGMAS**2:
            return ""
        # Faint light of a colour changes a light into its neighbour.
        why = "is the picture late, or does other light fall on the chart" if self._coloured() else ""
        return (
            f"another light is seen, {_named(found[1])}, {_named(self.codes)} was ordered; "
            f"does something else draw on the screen, {why or 'or is the picture late'}?"
        )

    def _near(self, plan: Sequence[Codes]) -> list[Codes]:
        """Return the codes whose amounts, by the tone curves alone, are nearest."""
        curves = self.model.curves()
        table = np.array(plan)
        predicted = np.stack([curves[primary, table[:, primary]] for primary in range(3)], axis=-1)
        off = np.linalg.norm(predicted - self.light.amounts, axis=1)
        return [plan[k] for k in np.argsort(off, kind="stable")[:_NEAREST].tolist()]

    def _added_of(self, of: Seen | None) -> tuple[float, float] | None:
        """Return how much neutral light added to the one ordered, or share of another frame's, explains what is seen.

        And the squared distance left; None where that is nothing, or unlikely. `of`: the other frame; None asks for
        neutral light.
        """
        h = self.expected.amounts
        if of is None:
            more = np.ones(3)
        elif of.amounts is None or of.codes == self.codes or not any(of.codes):
            return None
        else:
            # For a share of the time the other light was there instead.
            more = of.amounts - h
        # The lamp is where it was, within its scatter: what is added is asked for.
        scatter = (self.model.brightness_sd**2 + 1e-6) * np.outer(h, h)
        weight = np.linalg.inv(self.expected.covariance + self.light.covariance + scatter)
        power = float(more @ weight @ more)
        added = float(more @ weight @ (self.light.amounts - h)) / power
        off = self.light.amounts - h - added * more
        left = float(off @ weight @ off)
        if added <= 4 * power**-0.5 or added < 0.002 or left > limits.LIGHT_SIGMAS**2:
            return None
        return added, left

    def _coloured(self) -> float:
        """Return how much light of any colour, of white, is added to the one ordered; 0 where it is not just more."""
        h = self.expected.amounts
        off = self.light.amounts - h
        variance = np.diag(self.expected.with_lamp + self.light.covariance) + (self.model.brightness_sd * h) ** 2
        more = float(np.mean(off))
        return more if (off > -3 * np.sqrt(variance)).all() and limits.ADDED_LEAST < more < limits.ADDED_MOST else 0.0


def _ambient_reason(added: float) -> str:
    return (
        f"light from elsewhere, {100 * added:.1f} % of white, falls on the chart besides the projector's; "
        "darken the room, close the door, cover lamps and displays"
    )


def _brightness_reason(brightness: float) -> str:
    percent = 100 * float(np.expm1(brightness))
    if percent < 0:
        return (
            f"the light is {-percent:.1f} % weaker than expected, its colour is right; does the lamp fail, did its "
            "power mode, the picture's brightness, the shutter or the aperture change, or stands somebody in the light?"
        )
    return (
        f"the light is {percent:.1f} % stronger than expected, its colour is right; did the lamp's power mode, the "
        "picture's brightness, the shutter or the aperture change, or does other light fall on the chart?"
    )


def _without_model(light: FrameLight, codes: Codes, before: Seen | None) -> Check:
    """Return what can be said without frames of the primaries: whether nothing has changed since the frame before."""
    if before is None or before.amounts is None or before.codes == codes or not any(codes) or not any(before.codes):
        return Check("light")
    wanted = np.array([decode_srgb(np.array(c) / 255) for c in (codes, before.codes)])
    away = float(angles_deg(wanted[:1], wanted[1:])[0])
    brighter = abs(float(np.log(wanted[0].sum() / wanted[1].sum())))
    same = same_light(light.amounts, before.amounts, 0.005)
    reason = ""
    if same < 2 * limits.STALE_SIGMAS and (away > limits.NOMINAL_DEG or brighter > 0.2):
        reason = _stale_reason(before, codes)
    return Check("light", reason=reason)


def _stale_reason(before: Seen, codes: Codes) -> str:
    return (
        f"the light of the frame before, {_named(before.codes)}, is still seen, {_named(codes)} was ordered; does the "
        "screen stand still, or is sequence.settle_s too short?"
    )


def _named(codes: Codes) -> str:
    return "black" if not any(codes) else "({}, {}, {})".format(*codes)


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


def judge_evenness(
    basis: Basis, light: FrameLight, frame: Measured, moved_px: _Array, before: Seen | None = None
) -> tuple[list[Check], npt.NDArray[np.bool_]]:
    """Return whether a lit frame shows one light everywhere, and which tiles (T,) deviate, to be drawn.

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
    return checks, off if reason else np.zeros_like(off)


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
    ragged = _is_ragged(rest, wrong)
    if uneven and min(brighter, 1 - brighter) < _BY_TURNS and not ragged:
        return checks
    cause = "the file was damaged on its way: check the cable and the memory card"
    if uneven and not ragged:
        # What is drawn on the screen, too, is brighter here and darker there, and goes on from row to row.
        cause = f"look at the picture: a screen saver or a window covers the projector's, or {cause}"
    rows = np.flatnonzero(wrong.reshape(-1, SEGMENTS).any(axis=1))
    reason = (
        f"{len(rows)} rows of blocks, from row {2 * int(rows[0])} of the frame to {2 * int(rows[-1]) + 1}, do not show "
        f"what belongs there; {cause}"
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
            f"{share:.0%} of the frame are not what the primaries give together; does a screen saver or another "
            "program draw on the screen, did the picture change during the exposure, or does other light fall there?"
        )
    if median < _DARKER:
        return (
            f"{amount} are {-median:.0%} darker than the light of the rest; does somebody or something stand before "
            "the chart or the projector, does a window cover the picture, or did only a part of the picture change?"
        )
    passed = "did somebody walk past, " if median < 0 else ""
    return (
        f"{amount} show another light than the rest, {median:+.0%} bright; {passed}did only a part of the picture "
        "change, does a window cover it or a screen saver draw on it, or does other light fall there?"
    )


def _where(off: npt.NDArray[np.bool_]) -> str:
    """Return in words where tiles are: "top left", "right", "middle"."""
    rows, columns = np.nonzero(off.reshape(TILE_ROWS, TILE_COLUMNS))
    y, x = (float(np.mean(rows)) + 0.5) / TILE_ROWS, (float(np.mean(columns)) + 0.5) / TILE_COLUMNS
    words = ["top" if y < 0.38 else "bottom" if y > 0.62 else "", "left" if x < 0.38 else "right" if x > 0.62 else ""]
    return " ".join(word for word in words if word) or "in the middle"
