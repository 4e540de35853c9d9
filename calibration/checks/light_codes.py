"""Whether each light's white is what its codes give: frames that bear another light's name.

Each white is held against what its codes give by all the other lights of the session and by what is known of any
projector (`calibration.checks.projector_model`), and each statement is as certain as these are. Two questions are
asked:

- Is a white off its codes? By how much beyond four standard errors.
- Would two lights fit better if their names were exchanged? By how much more likely that is. How near two lights may be
  for their exchange to go unnoticed is a figure.

Of many lights the majority decides; of few, lights are left out, and names exchanged, until the rest agree
(docs/decisions/0015-lights-are-held-against-their-codes.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from calibration.checks.projector_model import ProjectorFit, fit_projector
from foundation.colorimetry import angles_deg

_Array = npt.NDArray[np.float64]

# Standard errors that are taken off an angle, or a brightness, so that noise is not taken for a wrong name.
CERTAIN = 4.0

# Twice the logarithm of the odds from which two names are called exchanged: a quarter of a million pairs are asked
# about in a session of 707 lights, for which 25 are taken off; what remains are odds of ten to one.
EXCHANGED = 30.0

# A light counts as held against its codes if no light further than this from it could bear its name unnoticed: the
# angle from which a table is refused.
HELD_DEG = 8.0

# Largest standard error, degrees, of what codes predict for a light to count as held: blue for red is 85° off.
_HELD_SD_DEG = 10.0

_FEW = 24  # Lights up to which each is left out in turn where names do not fit; of more, the majority decides

_SUSPECTS = 8  # Lights among which exchanged names are looked for then: those whose absence helps most

# Misfit by which exchanged names may be worse than leaving a light out, to be believed: that takes three numbers
# away, which each have 1 on average.
_AS_GOOD = 9.0

# Scatter of a channel against the others, relative: what healthy lamps have, and up to where that of the session at
# hand is believed to be its own. Beyond, a colour wheel is cut, or names are wrong; both are to be said.
_CHROMA_SD, _MOST_CHROMA_SD = 0.003, 0.012

# Scatter of a light's brightness, relative: lamps that flicker, and where no white frames show the lamp's drift.
_BRIGHTNESS_SD, _UNTIED_SD = 0.03, 0.06

# Misfit up to which the names of few lights are believed, and what each light adds. In 360 random healthy rooms it
# was below 6 + 1.7 a light, and with any two names exchanged that are 6° apart above 12 + 3.3.
_HEALTHY, _HEALTHY_EACH = 8.0, 2.5

# Squared distance of two whites from what their exchanged codes give, above which these are none of theirs: six
# dimensions have 6 on average and once in ten million times this.
_FITS = 50.0

_FREE = 10.0  # Standard deviation of a light's brightness, relative, where only its direction counts

# Squared distance of two predictions, over `EXCHANGED`, up to which an exchange is weighed whole: both lights would
# be off, so that twice this distance is to be expected of one.
_FAR = 3.0

_BLOCK_PAIRS = 20_000  # Pairs whose exchange is weighed at a time: a hundred megabytes

_Whole = npt.NDArray[np.int64]


@dataclass(frozen=True)
class ExchangedLights:
    """Two lights that fit better with their names exchanged.

    - `angle_deg`: angle between what the two codes give.
    - `evidence`: twice the logarithm of the odds that they are exchanged, all else left aside.
    """

    one: int
    other: int
    angle_deg: float
    evidence: float


@dataclass(frozen=True, eq=False)
class CodeAgreement:
    """How the whites of L lights agree with their codes.

    - `angle_deg`: (L,) float64 degrees between each white and the one that its codes give.
    - `error_deg`: (L,) float64 degrees, standard error of that, in the direction in which it is largest.
    - `off_deg`: (L,) float64 degrees, the angle beyond four standard errors; 0 where it is within.
    - `brightness`: (L,) float64, how much brighter a white is than its codes give, relative; −0.5 is half as bright.
    - `off_brightness`: (L,) float64, the same beyond four standard errors, ≥ 0.
    - `seen_as`: (L,) int64, for a light that is off its codes the one whose codes would give its white; −1 for none.
    - `exchanges`: lights that fit better with their names exchanged, the surest first.
    - `held`: (L,) bool, whether a light is held against its codes (`HELD_DEG`).
    - `exchange_deg`: largest angle between two lights whose exchange would go unnoticed; 0 where none would.
    - `misfit`: by how much whites and codes of few lights disagree, all taken together, over what healthy rooms have; 0
      of many.
    """

    angle_deg: _Array
    error_deg: _Array
    off_deg: _Array
    brightness: _Array
    off_brightness: _Array
    seen_as: _Whole
    exchanges: tuple[ExchangedLights, ...]
    held: npt.NDArray[np.bool_]
    exchange_deg: float
    misfit: float

    def rows(self, lights: slice) -> CodeAgreement:
        """Return the same of some lights alone; `seen_as` and `exchanges` name lights by the numbers they had."""
        own = {name: value[lights] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **own)


def code_agreement(
    codes: npt.NDArray[np.integer], white: _Array, error: _Array, *, dark_known: bool, drift_known: bool
) -> CodeAgreement:
    """Return how whites agree with their codes.

    `codes`: (L, 3) int64, 0 … 255, of different lights or of the same. `white`: (L, 3) float64 counts of bare paper,
    exposed alike, the lamp's drift and what is there at black taken off. `error`: (L, 3) float64 counts, standard
    errors.
    """
    # Its matrices are small: threads of the linear algebra wait for each other longer than they work.
    with threadpool_limits(limits=1, user_api="blas"):
        fit, swapped, misfit = _fitted(np.asarray(codes), white, error, dark_known=dark_known, drift_known=drift_known)
    count = len(white)
    mean, spread = fit.predicted(np.arange(count)[:, None])
    angle, deviation, error_deg = _directions(mean, spread, white)
    off_deg = angle * np.maximum(1 - CERTAIN / np.maximum(deviation, 1e-9), 0)
    brightness, off_brightness = _brightness(mean, spread, white)
    pairs, evidence, expected, apart = _pairs(fit, mean, spread, off_deg > 0)
    held, unnoticed = error_deg < _HELD_SD_DEG, expected < EXCHANGED
    held[pairs[unnoticed & (apart > HELD_DEG)].ravel()] = False
    found = np.flatnonzero(evidence > EXCHANGED)
    exchanges = [
        ExchangedLights(int(pairs[k, 0]), int(pairs[k, 1]), float(apart[k]), float(evidence[k]))
        for k in found[np.argsort(-evidence[found], kind="stable")].tolist()
    ]
    if swapped is not None:
        # Found by whole fits, which reach further than the tangent at this one.
        one, other = swapped
        k = int(np.flatnonzero((pairs == swapped).all(axis=1))[0])
        exchanges = [ExchangedLights(one, other, float(apart[k]), max(float(evidence[k]), EXCHANGED)), *exchanges]
    return CodeAgreement(
        angle_deg=angle,
        error_deg=error_deg,
        off_deg=off_deg,
        brightness=brightness,
        off_brightness=off_brightness,
        seen_as=_seen_as(mean, spread, white, off_deg),
        exchanges=_each_once(exchanges),
        held=held,
        exchange_deg=float(apart[unnoticed].max(initial=0.0)),
        misfit=misfit,
    )


def _fitted(
    codes: npt.NDArray[np.integer], white: _Array, error: _Array, *, dark_known: bool, drift_known: bool
) -> tuple[ProjectorFit, tuple[int, int] | None, float]:
    """Return the fit to lights that agree, the exchange of names that makes them agree, and the misfit of all.

    The misfit is over that of healthy rooms; 0 of many lights, among which some may be off.
    """
    brightness_sd = _BRIGHTNESS_SD if drift_known else _UNTIED_SD

    def fit(codes: npt.NDArray[np.integer], chroma_sd: float, used: npt.NDArray[np.bool_] | None) -> ProjectorFit:
        return fit_projector(
            codes, white, error, dark_known=dark_known, chroma_sd=chroma_sd, brightness_sd=brightness_sd, used=used
        )

    count = len(white)
    if count > _FEW:
        found = fit(codes, _CHROMA_SD, None)
        _, deviation, _ = _directions(*found.predicted(np.arange(count)[:, None]), white)
        # The median of the square of a distance of two dimensions is 1.39.
        scatter = _CHROMA_SD * float(np.sqrt(max(np.median(deviation**2) / 1.39, 1.0)))
        if scatter > _CHROMA_SD:
            found = fit(codes, min(scatter, _MOST_CHROMA_SD), None)
        return found, None, 0.0
    every = np.ones(count, dtype=np.bool_)
    found = fit(codes, _CHROMA_SD, every)
    misfit = found.misfit / _healthy(count)
    if misfit < 1 or count < 2:
        return found, None, misfit
    used = every
    for _ in range(count // 2):
        without = {light: used & (np.arange(count) != light) for light in np.flatnonzero(used).tolist()}
        fits = {light: fit(codes, _CHROMA_SD, rest) for light, rest in without.items()}
        ranked = sorted(fits, key=lambda light: fits[light].misfit)
        nearest = fits[ranked[0]]
        healed = nearest.misfit < _healthy(int(used.sum()) - 1)
        if used.all():
            swap, left = _healing_exchange(fit, codes, found.misfit, ranked[:_SUSPECTS])
            if swap is not None and left < nearest.misfit + _AS_GOOD:
                rest = ~np.isin(np.arange(count), swap)
                return fit(codes, _CHROMA_SD, rest), swap, misfit
        used, found = without[ranked[0]], nearest
        if healed:
            break
    return found, None, misfit


def _healthy(lights: int) -> float:
    """Return the misfit up to which whites agree: measured on random healthy rooms, with 2 to 20 lights."""
    return _HEALTHY + _HEALTHY_EACH * lights


def _healing_exchange(
    fit: Callable[[npt.NDArray[np.integer], float, npt.NDArray[np.bool_] | None], ProjectorFit],
    codes: npt.NDArray[np.integer],
    misfit: float,
    suspects: Sequence[int],
) -> tuple[tuple[int, int] | None, float]:
    """Return the two of some lights whose exchanged names make all lights agree, None without, and the misfit left."""
    best, found = _healthy(len(codes)), None
    for one, other in combinations(sorted(suspects), 2):
        exchanged = codes.copy()
        exchanged[[one, other]] = codes[[other, one]]
        left = fit(exchanged, _CHROMA_SD, np.ones(len(codes), dtype=np.bool_)).misfit
        if left < best and misfit - left > EXCHANGED / 2:
            best, found = left, (one, other)
    return found, best


def _directions(mean: _Array, spread: _Array, white: _Array) -> tuple[_Array, _Array, _Array]:
    """Return the angle (L,) degrees between whites and predictions, it in standard errors, and the largest of these.

    Brightness is left free: a lamp that flickers is no wrong name.
    """
    toward = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    along = np.asarray(_FREE**2 * (white**2).sum(axis=1), dtype=np.float64)
    free: _Array = spread + along[:, None, None] * toward[:, :, None] * toward[:, None]
    # The prediction as bright as the white: what is off is then across it, as an angle is.
    level = np.maximum((white * toward).sum(axis=1, keepdims=True), 0)
    off = white - level * toward
    deviation = np.sqrt(
        np.maximum(np.einsum("lc,lcd,ld->l", off, np.asarray(np.linalg.inv(free), dtype=np.float64), off), 0)
    )
    across = np.eye(3) - toward[:, :, None] * toward[:, None]
    largest = np.linalg.eigvalsh(across @ spread @ across)[:, -1]
    error = np.degrees(np.sqrt(np.maximum(largest, 0)) / np.maximum(np.linalg.norm(mean, axis=1), 1e-9))
    return angles_deg(mean, white), deviation, np.minimum(error, 180.0)


def _brightness(mean: _Array, spread: _Array, white: _Array) -> tuple[_Array, _Array]:
    """Return how much brighter whites (L,) are than predicted, relative, and that beyond four standard errors."""
    length = np.maximum(np.linalg.norm(mean, axis=1), 1e-9)
    toward = mean / length[:, None]
    more = (white * toward).sum(axis=1) / length - 1
    error = np.sqrt(np.einsum("lc,lcd,ld->l", toward, spread, toward)) / length
    return more, np.maximum(np.abs(more) - CERTAIN * error, 0)


def _pairs(
    fit: ProjectorFit, mean: _Array, spread: _Array, off: npt.NDArray[np.bool_]
) -> tuple[_Whole, _Array, _Array, _Array]:
    """Return pairs of lights (P, 2), the evidence (P,) for an exchange, that to expect of one, and degrees apart.

    All pairs of few lights; of many those that are near each other, and those of which one is `off` its codes: others
    would be far off if they were exchanged. `mean` (L, 3) and `spread` (L, 3, 3) are the predictions.
    """
    pairs = np.stack(np.triu_indices(len(fit.white), 1), axis=-1)
    if len(fit.white) > _FEW:
        one, other = pairs.T
        between = mean[one] - mean[other]
        far2 = np.einsum("pa,pab,pb->p", between, np.linalg.inv(spread[one] + spread[other]), between)
        pairs = pairs[(far2 < _FAR * EXCHANGED) | off[one] | off[other]]
    blocks = [pairs[at : at + _BLOCK_PAIRS] for at in range(0, len(pairs), _BLOCK_PAIRS)]
    found = [_weighed(fit, block) for block in blocks]
    none = (np.zeros(0),) * 3
    evidence, expected, apart = (np.concatenate(parts) for parts in zip(none, *found, strict=True))
    return pairs, evidence, expected, apart


def _weighed(fit: ProjectorFit, pairs: _Whole) -> tuple[_Array, _Array, _Array]:
    mean, spread = fit.predicted(pairs)
    inverse = np.linalg.inv(spread)

    def distance2(off: _Array) -> _Array:
        return np.einsum("pa,pab,pb->p", off, inverse, off)

    named, exchanged = (fit.white[lights].reshape(-1, 6) - mean for lights in (pairs, pairs[:, ::-1]))
    between = mean[:, 3:] - mean[:, :3]
    expected = distance2(np.concatenate([between, -between], axis=1))
    left = distance2(exchanged)
    # Exchanged names must not only fit better, they must fit.
    evidence = np.where(left < _FITS, distance2(named) - left, 0.0)
    return evidence, expected, angles_deg(mean[:, :3], mean[:, 3:])


def _seen_as(mean: _Array, spread: _Array, white: _Array, off_deg: _Array) -> _Whole:
    """Return for each light that is off its codes the light (L,) whose codes would give its white, −1 for none."""
    seen_as = np.full(len(white), -1, dtype=np.int64)
    for light in np.flatnonzero(off_deg > 0).tolist():
        given = np.broadcast_to(white[light], mean.shape)
        angle, deviation, _ = _directions(mean, spread, given)
        deviation[light] = np.inf
        like = int(np.argmin(deviation))
        if deviation[like] < CERTAIN and angle[like] < off_deg[light]:
            seen_as[light] = like
    return seen_as


def _each_once(exchanges: Sequence[ExchangedLights]) -> tuple[ExchangedLights, ...]:
    """Return exchanges with each light in one of them, the first that names it."""
    named: set[int] = set()
    kept: list[ExchangedLights] = []
    for pair in exchanges:
        if named.isdisjoint({pair.one, pair.other}):
            named |= {pair.one, pair.other}
            kept.append(pair)
    return tuple(kept)
