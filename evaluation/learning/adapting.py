"""What a method has learned elsewhere, adapted to N images of the camera at hand.

Two models answer together. One was learned elsewhere, on generated images as a rule, and is tuned to the N as its
method does that (`FeatureLearner.tune`). The other is what the same method learns of the N alone. The light is their
mean in logarithms, the first with the weight w.

What was learned elsewhere is taken to be worth as much as W images, `WORTH`, however many it was learned of. Methods
that learn of both together let each of the N weigh by that; and w begins with stacking (L. Breiman, "Stacked
regressions", Machine Learning 24, 1996) under a prior. The least sum of errors on the N, each estimated by models that
have not seen it, would choose it, and on twenty images choose badly; so that much is added for a w other than expected
as `STRENGTH` images would: expected is W / (W + N), and 1 where the first was tuned, and so knows the N as well. The
models that are compared are both worse than what they stand for: the one is not yet tuned, the other has learned of
fewer than N. What was learned elsewhere does not grow better with N: so w is multiplied by W⁴ / (W⁴ + N⁴), and from
twice W on little is left of it whatever stacking says. No image that is tested on has a part in it.

`WORTH`, `STRENGTH` and how each method tunes were chosen by docs/transfer.md#what-was-chosen-and-on-what.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LearnedMethod, LightModel, fit_extracted
from evaluation.metrics import recovery_error

WORTH: Final = 200.0  # Images that what was learned elsewhere is taken to be worth before any is seen
STRENGTH: Final = 25.0  # Images that this opinion weighs as much as
_SHARES: Final = np.linspace(0, 1, 101)  # Weights to choose among
# Parts of the N images, each estimated by a model that learned of the others; so few since each is a training.
_PARTS: Final = 3


@dataclass(frozen=True, eq=False)
class LearnedAlone:
    """What N images teach a method that knows nothing else.

    - `method`: what it learned of all N.
    - `features`: (N, ...), of those with a usable pixel.
    - `truths`: (N, 3) float64, r + g + b = 1.
    - `held_out`: (N, 3) float64, the light of each by what was learned of the other parts; None of fewer images than
      parts.
    - `seed`: of the fits.
    """

    method: LearnedMethod
    features: Features
    truths: npt.NDArray[np.float64]
    held_out: npt.NDArray[np.float64] | None
    seed: int


def learn_alone(
    learner: FeatureLearner, features: Sequence[Features | None], truths: npt.NDArray[np.float64], seed: int = 0
) -> LearnedAlone:
    """Return what N images teach, of features, (...) of the learner's dtype or None, and truths (N, 3) float64."""
    method = fit_extracted(learner, features, truths, seed)
    usable = [place for place, given in enumerate(features) if given is not None]
    stacked: Any = np.stack([given for given in features if given is not None])
    lights = truths[usable] / truths[usable].sum(axis=1, keepdims=True)
    held_out = None
    if len(usable) >= _PARTS:
        held_out = np.empty_like(lights)
        parts = np.random.default_rng(seed).permutation(len(usable)) % _PARTS
        for part in range(_PARTS):
            held = parts == part
            held_out[held] = learner.fit_features(stacked[~held], lights[~held], seed).lights(stacked[held])
    return LearnedAlone(method, stacked, lights, held_out, seed)


def adapt(taught: LearnedMethod, alone: LearnedAlone, worth: float = WORTH) -> LearnedMethod:
    """Return a method that was learned elsewhere, adapted to what N images teach alone.

    `worth`: images that the former is taken to be worth, 0 for nothing: then the latter is returned.
    """
    if taught.learner != alone.method.learner:
        raise ValueError(f"{taught.learner} was learned elsewhere, {alone.method.learner} here; expected the same")
    if not worth > 0:
        return alone.method
    elsewhere, count = taught.model, len(alone.features)
    # What was adapted before has two models, each of another camera: it is taken as it is.
    tuned = elsewhere
    if not isinstance(elsewhere, BlendedModel):
        tuned = taught.learner.tune(elsewhere, alone.features, alone.truths, worth, alone.seed)
    share = worth / (worth + count) if tuned is elsewhere else 1.0
    if alone.held_out is not None:
        share = stacked_share(elsewhere.lights(alone.features), alone.held_out, alone.truths, share)
    share *= worth**4 / (worth**4 + count**4)
    return replace(taught, model=BlendedModel(tuned, alone.method.model, np.array(share)))


def stacked_share(
    one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], truths: npt.NDArray[np.float64], expected: float
) -> float:
    """Return the share, 0 … 1, of the first of two estimates (N, 3) float64 of true lights (N, 3) float64.

    Examples
    --------
    Where the first is right and the second wrong, images outweigh an opinion against the first, enough of them wholly:

    >>> truths, wrong = np.tile([0.3, 0.4, 0.3], (450, 1)), np.tile([0.2, 0.4, 0.4], (450, 1))
    >>> [round(stacked_share(truths[:n], wrong[:n], truths[:n], 0.0), 1) for n in (0, 25, 450)]
    [0.0, 0.5, 1.0]
    """
    if not len(truths):
        return expected
    errors = np.array([recovery_error(_mean(one, other, share), truths).sum() for share in _SHARES])
    opinion = STRENGTH * recovery_error(one, other).mean() * (_SHARES - expected) ** 2
    return float(_SHARES[np.argmin(errors + opinion)]) if opinion.any() else expected


def _mean(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], share: float) -> npt.NDArray[np.float64]:
    """Return the lights (N, 3) between lights (N, 3), r + g + b = 1: their mean in logarithms, with a share of one."""
    lights = np.exp(share * np.log(one) + (1 - share) * np.log(other))
    return lights / lights.sum(axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class BlendedModel:
    """Two models that answer together.

    - `elsewhere`, `here`: what was learned elsewhere and then tuned, and what the N images taught alone.
    - `share`: () float64, 0 … 1, the weight of the first in the mean of the logarithms of both lights.
    """

    elsewhere: LightModel
    here: LightModel
    share: npt.NDArray[np.float64]

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, r + g + b = 1, of features (N, ...) of the learner's dtype."""
        return _mean(self.elsewhere.lights(features), self.here.lights(features), float(self.share))

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays of both, of any shape and dtype, under `elsewhere.` and `here.`, and the `share`."""
        both = {"elsewhere": self.elsewhere, "here": self.here}
        named = {f"{part}.{name}": array for part, model in both.items() for name, array in model.arrays().items()}
        return {"share": self.share, **named}


def restore(learner: FeatureLearner, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightModel:
    """Return the model whose arrays (any shape and dtype) are given, adapted or not; see `FeatureLearner.restore`."""
    if "share" not in arrays:
        return learner.restore(arrays)
    share = np.asarray(arrays["share"], dtype=np.float64)
    if share.shape != () or not 0 <= share <= 1:
        raise ValueError(f"a share of {share.tolist()}; expected a number from 0 to 1")
    elsewhere, here = (
        {name.removeprefix(part): array for name, array in arrays.items() if name.startswith(part)}
        for part in ("elsewhere.", "here.")
    )
    return BlendedModel(restore(learner, elsewhere), restore(learner, here), share)
