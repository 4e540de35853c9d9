"""Adapt a pretrained model to N images of another camera.

The estimates of two models are combined. The pretrained model was usually fitted to generated images, and may be tuned
to the N images (`FeatureLearner.tune`). The local model is fitted to the N images alone. The result is the weighted
mean of the logarithms of both estimates. The pretrained model has the weight w, the local model 1 - w.

Test images are not used. docs/decisions/0044-adapted-is-two-models-and-a-weight.md explains the constants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LearnedMethod, LightModel, fit_extracted
from evaluation.metrics import recovery_error

PRETRAINED_WORTH: Final = 200.0  # W: number of local images to which a pretrained model is equivalent
PRIOR_IMAGES: Final = 25.0  # weight of the prior for w, as a number of images
_WEIGHTS: Final = np.linspace(0, 1, 101)  # candidates for w
_FOLDS: Final = 3  # folds of the N images for cross-validation; few, because each fold requires a fit


@dataclass(frozen=True, eq=False)
class LocalFit:
    """Method fitted to N local images.

    - `method`: method fitted to all N images.
    - `features`: (N, ...) features of the images with usable pixels.
    - `truths`: (N, 3) float64, r + g + b = 1.
    - `held_out`: (N, 3) float64, estimate of each image by a model fitted to the other folds; None if there are
      fewer images than folds.
    - `seed`: seed of the fits.
    """

    method: LearnedMethod
    features: Features
    truths: npt.NDArray[np.float64]
    held_out: npt.NDArray[np.float64] | None
    seed: int


def fit_local(
    learner: FeatureLearner, features: Sequence[Features | None], truths: npt.NDArray[np.float64], seed: int = 0
) -> LocalFit:
    """Fit a learner to features and ground truths (N, 3) float64 of N local images; features may be None."""
    method = fit_extracted(learner, features, truths, seed)
    usable = [index for index, image_features in enumerate(features) if image_features is not None]
    stacked: Any = np.stack([image_features for image_features in features if image_features is not None])
    lights = truths[usable] / truths[usable].sum(axis=1, keepdims=True)
    held_out = None
    if len(usable) >= _FOLDS:
        held_out = np.empty_like(lights)
        fold_indices = np.random.default_rng(seed).permutation(len(usable)) % _FOLDS
        for fold in range(_FOLDS):
            tested = fold_indices == fold
            held_out[tested] = learner.fit_features(stacked[~tested], lights[~tested], seed).lights(stacked[tested])
    return LocalFit(method, stacked, lights, held_out, seed)


def adapt(pretrained: LearnedMethod, local_fit: LocalFit, worth: float = PRETRAINED_WORTH) -> LearnedMethod:
    """Return a pretrained method adapted to a local fit; with `worth` 0, return the local method.

    `worth` is W, the number of local images to which the pretrained method is equivalent.
    """
    if pretrained.learner != local_fit.method.learner:
        raise ValueError(f"pretrained {pretrained.learner}, local {local_fit.method.learner}, expected equal learners")
    if not worth > 0:
        return local_fit.method
    model, count = pretrained.model, len(local_fit.features)
    # An adapted model consists of models of two cameras and cannot be tuned.
    tuned = model
    if not isinstance(model, BlendedModel):
        tuned = pretrained.learner.tune(model, local_fit.features, local_fit.truths, worth, local_fit.seed)
    # The expected w is W / (W + N). After tuning, w is expected to be 1, because tuning has already used the N images.
    share = worth / (worth + count) if tuned is model else 1.0
    if local_fit.held_out is not None:
        share = stacked_share(model.lights(local_fit.features), local_fit.held_out, local_fit.truths, share)
    # A pretrained model does not improve with N. From N = 2 W, its weight is small even if stacking returns 1.
    share *= worth**4 / (worth**4 + count**4)
    return replace(pretrained, model=BlendedModel(tuned, local_fit.method.model, np.array(share)))


def stacked_share(
    first: npt.NDArray[np.float64], second: npt.NDArray[np.float64], truths: npt.NDArray[np.float64], expected: float
) -> float:
    """Return the weight, 0 … 1, of the first of two estimates (N, 3) float64 of ground truths (N, 3) float64.

    `expected`: weight that is returned if there are no images, and to which the prior draws.

    Examples
    --------
    The expected weight is 0, but only the first estimate is correct. Its weight increases with the number of images:

    >>> truths, wrong = np.tile([0.3, 0.4, 0.3], (450, 1)), np.tile([0.2, 0.4, 0.4], (450, 1))
    >>> [round(stacked_share(truths[:n], wrong[:n], truths[:n], 0.0), 1) for n in (0, 25, 450)]
    [0.0, 0.5, 1.0]
    """
    # Stacking: L. Breiman, "Stacked regressions", Machine Learning 24, 1996. A prior is added, because twenty images
    # are too few to select the weight. Also, the final models are fitted to more images than the models compared here.
    if not len(truths):
        return expected
    errors = np.array([recovery_error(_log_mean(first, second, share), truths).sum() for share in _WEIGHTS])
    prior_errors = PRIOR_IMAGES * recovery_error(first, second).mean() * (_WEIGHTS - expected) ** 2
    return float(_WEIGHTS[np.argmin(errors + prior_errors)]) if prior_errors.any() else expected


def _log_mean(first: npt.NDArray[np.float64], second: npt.NDArray[np.float64], share: float) -> npt.NDArray[np.float64]:
    lights = np.exp(share * np.log(first) + (1 - share) * np.log(second))
    return lights / lights.sum(axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class BlendedModel:
    """Model that averages the estimates of two models.

    - `pretrained`: the pretrained model; it is tuned if its method supports tuning.
    - `local`: the model fitted to the N local images.
    - `share`: () float64, 0 … 1, weight of the pretrained model in the mean of the logarithms.
    """

    pretrained: LightModel
    local: LightModel
    share: npt.NDArray[np.float64]

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates (N, 3) float64, r + g + b = 1, for features (N, ...) of the learner's dtype."""
        return _log_mean(self.pretrained.lights(features), self.local.lights(features), float(self.share))

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays of both models with the prefixes `elsewhere.` and `here.`, and the `share`."""
        models = {"elsewhere": self.pretrained, "here": self.local}
        arrays = {f"{key}.{name}": array for key, model in models.items() for name, array in model.arrays().items()}
        return {"share": self.share, **arrays}


def restore(learner: FeatureLearner, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightModel:
    """Return the model with these arrays, blended or not; see `FeatureLearner.restore`."""
    if "share" not in arrays:
        return learner.restore(arrays)
    share = np.asarray(arrays["share"], dtype=np.float64)
    if share.shape != () or not 0 <= share <= 1:
        raise ValueError(f"the share is {share.tolist()}, expected a number from 0 to 1")
    pretrained, local = (
        {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
        for prefix in ("elsewhere.", "here.")
    )
    return BlendedModel(restore(learner, pretrained), restore(learner, local), share)
