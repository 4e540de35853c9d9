"""What a method has learned elsewhere, adapted to N images of the camera at hand.

Two models answer together. One was learned elsewhere, on generated images as a rule, and is tuned to the N as its
method does that (`FeatureLearner.tune`). The other is what the same method learns of the N alone. The light is their
mean in logarithms, the first with the weight w.

w is found by stacking (L. Breiman, "Stacked regressions", Machine Learning 24, 1996) under a prior. Least squares on
the N, each estimated by models that have not seen it, would choose it, and on twenty images choose badly; so the
squares of `STRENGTH` images more are added that say w = `WORTH` / (`WORTH` + N): what was learned elsewhere is taken
to be worth as much as that many images. The more images, the less the prior says, and the more they decide. No image
that is tested on has a part in it.

`WORTH`, `STRENGTH` and how each method tunes were chosen by docs/transfer.md#what-was-chosen-and-on-what.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LearnedMethod, LightModel, fit_extracted

WORTH: Final = 200.0
"""Images that what was learned elsewhere is taken to be worth before any is seen."""
STRENGTH: Final = 50.0
"""Images that this opinion weighs as much as."""
_PARTS: Final = 3
"""Parts of the N images, each estimated by models that learned of the others; so few since each is a training."""


@dataclass(frozen=True, eq=False)
class LearnedAlone:
    """What N images teach a method that knows nothing else.

    - `method`: what it learned of all N.
    - `features`: (N, ...), of those with a usable pixel.
    - `truths`: (N, 3) float64, r + g + b = 1.
    - `parts`: (N,) int64, the part of each.
    - `held_out`: (N, 3) float64, the light of each by what was learned of the other parts; None of fewer images than
      parts.
    - `seed`: of the fits.
    """

    method: LearnedMethod
    features: Features
    truths: npt.NDArray[np.float64]
    parts: npt.NDArray[np.int64]
    held_out: npt.NDArray[np.float64] | None
    seed: int


def learn_alone(
    learner: FeatureLearner, features: Sequence[Features | None], truths: npt.NDArray[np.float64], seed: int = 0
) -> LearnedAlone:
    """Return what N images teach; see `feature_learner.fit_extracted` for what is given."""
    method = fit_extracted(learner, features, truths, seed)
    usable = [place for place, given in enumerate(features) if given is not None]
    stacked: Any = np.stack([given for given in features if given is not None])
    lights = truths[usable] / truths[usable].sum(axis=1, keepdims=True)
    parts = np.random.default_rng(seed).permutation(len(usable)).astype(np.int64) % _PARTS
    held_out = None
    if len(usable) >= _PARTS:
        held_out = np.empty_like(lights)
        for part in range(_PARTS):
            held = parts == part
            held_out[held] = learner.fit_features(stacked[~held], lights[~held], seed).lights(stacked[held])
    return LearnedAlone(method, stacked, lights, parts, held_out, seed)


def adapt(taught: LearnedMethod, alone: LearnedAlone, worth: float = WORTH) -> LearnedMethod:
    """Return a method that was learned elsewhere, adapted to what N images teach alone.

    `worth`: images that the former is taken to be worth, 0 for nothing: then the latter is returned.
    """
    if not worth > 0:
        return alone.method
    learner, elsewhere = taught.learner, taught.model
    tuned = _tuned(learner, elsewhere, alone.features, alone.truths, alone.seed)
    share = worth / (worth + len(alone.features))
    if alone.held_out is not None:
        seen = np.empty_like(alone.truths)
        for part in range(_PARTS):
            held = alone.parts == part
            model = _tuned(learner, elsewhere, alone.features[~held], alone.truths[~held], alone.seed)
            seen[held] = model.lights(alone.features[held])
        share = stacked_share(seen, alone.held_out, alone.truths, share)
    return replace(taught, model=BlendedModel(tuned, alone.method.model, np.array(share)))


def _tuned(
    learner: FeatureLearner,
    elsewhere: LightModel,
    features: Features,
    truths: npt.NDArray[np.float64],
    seed: int,
) -> LightModel:
    # What was adapted before has two models, each of another camera: it is taken as it is.
    return elsewhere if isinstance(elsewhere, BlendedModel) else learner.tune(elsewhere, features, truths, seed)


def stacked_share(
    one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], truths: npt.NDArray[np.float64], expected: float
) -> float:
    """Return the share, 0 … 1, of the first of two estimates (N, 3) float64 of true lights (N, 3) float64.

    Examples
    --------
    Where the first is right, the images outweigh an opinion against it, the more of them the more:

    >>> truths, wrong = np.tile([0.3, 0.4, 0.3], (450, 1)), np.tile([0.2, 0.4, 0.4], (450, 1))
    >>> [round(stacked_share(truths[:n], wrong[:n], truths[:n], 0.0), 2) for n in (50, 450)]
    [0.5, 0.9]
    """
    first, second, wanted = (_logs(lights) for lights in (one, other, truths))
    apart = first - second
    squares = float((apart**2).sum())
    if squares == 0:
        return expected
    prior = STRENGTH * squares / len(apart)
    share = (float(((wanted - second) * apart).sum()) + prior * expected) / (squares + prior)
    return float(np.clip(share, 0, 1))


def _logs(lights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return ln r/g and ln b/g, (N, 2) float64, of lights (N, 3)."""
    logs = np.log(lights)
    return logs[:, [0, 2]] - logs[:, 1:2]


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
        share = float(self.share)
        mean = share * np.log(self.elsewhere.lights(features)) + (1 - share) * np.log(self.here.lights(features))
        lights = np.exp(mean)
        return lights / lights.sum(axis=1, keepdims=True)

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
