"""Several lights at once, with the noise one exposure would have had.

Light is additive: under lights i of weights w_i a colour's mean is Σ w_i m_i, m_i its mean under light i alone. Noise
is not: a sample is x_i = m_i + n_i, where the variance of n_i is g m_i + r² (photons at gain g, and read noise r), and
one exposure under all lights has the variance g Σ w_i m_i + r². A weighted mean of samples would have g Σ w_i² m_i, too
quiet by half for two equal lights. Scaling deviations by the square root of the weight,

    y = Σ w_i m_i + Σ √w_i (x_i − m_i),   x_i drawn for each light on its own,

has the variance Σ w_i (g m_i + r²): photon noise exact for any weights, read noise exact where the weights sum to 1 and
√(Σ w_i) times too large otherwise. Weight 1 of one light gives that light's samples to the last bit.

What is approximate: m_i is the mean of the table's S samples and not of all paper of that colour; print and pixel
patterns that deviate in proportion to the light count as noise (their mixture is too quiet by √(Σ w_i²) for lights of
one brightness); samples clipped by the sensor stay clipped before they are mixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.errors import InputError
from generator import philox
from generator.compiled import compiled
from generator.palette import bits_of

Samples = npt.NDArray[np.uint16]


@compiled
def _mix_table(samples: Any, weight: float, words: Any, total: Any) -> None:
    """Add one light to `total` (C, S, 3) float64; sample i of each colour takes the place its shuffle gives it."""
    colours, count = samples.shape[0], samples.shape[1]
    root = np.sqrt(weight)
    order = np.empty(count, np.int64)
    for colour in range(colours):
        for i in range(count):
            order[i] = i
        for i in range(words.shape[1]):
            j = i + ((np.uint64(words[colour, i]) * np.uint64(count - i)) >> np.uint64(32))
            order[i], order[j] = order[j], order[i]
        for channel in range(3):
            mean = 0.0
            for i in range(count):
                mean += samples[colour, i, channel]
            mean /= count
            for i in range(count):
                total[colour, i, channel] += root * samples[colour, order[i], channel] + (weight - root) * mean


def checked_weights(weights: npt.ArrayLike, lights: int) -> npt.NDArray[np.float64]:
    """Return `weights` as (K,) float64 after looking at them.

    Raises
    ------
    InputError
        They are not one finite number ≥ 0 a light.
    """
    checked = np.asarray(weights, dtype=np.float64)
    if checked.shape != (lights,) or not np.isfinite(checked).all() or (checked < 0).any():
        raise InputError(f"the weights are {np.asarray(weights).tolist()}, expected {lights} finite numbers from 0")
    return checked


def checked_tables(tables: Samples | Sequence[Samples]) -> list[Samples]:
    """Return the lights' samples as a list after looking at them.

    Raises
    ------
    InputError
        There is none, or they are not uint16 (8**bits, samples, 3), all alike.
    """
    checked = list(tables)
    if not checked:
        raise InputError("no light was given to mix; give at least one")
    for table in checked:
        if table.dtype != np.uint16 or table.ndim != 3 or table.shape[2] != 3 or not table.shape[1]:
            raise InputError(f"the samples are {table.dtype} {table.shape}, expected uint16 (8**bits, samples, 3)")
        if table.shape != checked[0].shape:
            raise InputError(f"the lights' samples are {checked[0].shape} and {table.shape}, expected one shape")
    bits_of(checked[0].shape[0])
    return checked


def mixed_table(
    tables: Samples | Sequence[Samples], weights: npt.ArrayLike, *, white_level: int = 65535, seed: int = 0
) -> Samples:
    """Return the samples of a light that is the mixture of some lights; the formula stands at the head of this file.

    The result is used as a light's samples: `draw_samples(mixed_table(...), picture)`. Each colour's samples of the
    first light with a weight keep their order; those of each further light are shuffled on their own, so that the
    lights' noises meet by chance.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16 or a sequence of K (8**bits, S, 3), linear camera RGB of the lights.
    weights
        (K,) ≥ 0, what each light contributes; 1 is the light as it was photographed.
    white_level
        Saturation of the sensor: larger values are cut to it.
    seed
        Of the shuffles, 0 … 2⁶⁴ − 1.

    Returns
    -------
    ndarray
        (8**bits, S, 3) uint16, rounded to the nearest count, halves up.

    Raises
    ------
    InputError
        A shape, type or number is not as above.
    """
    lights = checked_tables(tables)
    checked = checked_weights(weights, len(lights))
    if not 1 <= white_level <= 65535:
        raise InputError(f"the white level is {white_level}, expected 1 to 65535")
    colours, count, _ = lights[0].shape
    total = np.zeros(lights[0].shape, np.float64)
    shuffled = False
    for light, (samples, weight) in enumerate(zip(lights, checked, strict=True)):
        if weight == 0:
            continue
        words = np.zeros((colours, 0), np.uint32)
        if shuffled:
            step: npt.NDArray[np.int64] = np.arange(count // 4 + 1, dtype=np.int64)
            four = philox.words(seed, np.arange(colours)[:, None], step, light, philox.MIXTURES)
            words = np.stack(four, axis=-1).reshape(colours, -1)[:, : count - 1]
        _mix_table(samples, float(weight), words, total)
        shuffled = True
    np.clip(np.floor(total + 0.5, out=total), 0, white_level, out=total)
    return total.astype(np.uint16)
