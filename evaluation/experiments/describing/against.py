"""One data set beside another, figure by figure: how real is what was generated.

Images of the two have nothing to do with each other: each set is resampled by itself (`bootstrap.independent`). Two
figures are called alike where the one lies within a quarter of the other: a ratio of 1/1.25 … 1.25, or, for figures
with a sign, a difference within a quarter of the other's spread over its images. The quarter is a convention. Real
photographs of two cameras by one group (Canon 600D and 1Ds Mark III of NUS) are alike by it in 18 of 21 figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from evaluation.experiments.bootstrap import independent
from evaluation.experiments.describing.description import DataDescription, known_values, summed
from evaluation.experiments.describing.quantities import QUANTITIES, Quantity

TOLERANCE: Final = 0.25
"""Share by which figures may differ and still be called alike: a convention."""

_LEAST: Final = 3
"""Images of which a figure must be known in each set: a quartile needs them."""

Verdict = Literal["yes", "yes?", "no?", "no"]
"""Whether a figure is within the tolerance; with a question mark where its interval reaches over the border."""


@dataclass(frozen=True)
class FigureCompared:
    """A figure of a data set beside that of another.

    - `change`: one / other, or one - other of a figure with a sign, and its interval of 95 %; NaN where `other` is 0.
    - `scale`: what a difference is measured by: the other's spread over its images; 1 for a ratio.
    - `distance`, `p`: two-sample Kolmogorov-Smirnov statistic of the images' numbers, 0 … 1, and the probability of
      such a one where both sets are of one kind.
    - `verdict`: whether the change is within `TOLERANCE`; None where it is not known.
    """

    quantity: Quantity
    one: float
    other: float
    change: tuple[float, float, float]
    scale: float
    distance: float
    p: float
    verdict: Verdict | None


def compare_figures(one: DataDescription, other: DataDescription, seed: int = 0) -> tuple[FigureCompared, ...]:
    """Return every figure that is known of both sets, of at least three images each."""
    compared: list[FigureCompared] = []
    for quantity in QUANTITIES:
        values = [known_values(described, quantity.value) for described in (one, other)]
        if min(map(len, values)) >= _LEAST:
            compared.append(_compared(quantity, values[0], values[1], seed))
    return tuple(compared)


def _compared(
    quantity: Quantity, one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], seed: int
) -> FigureCompared:
    from scipy.stats import ks_2samp

    values = summed(one, quantity.summed), summed(other, quantity.summed)
    scale = float(other.std()) if quantity.signed else 1.0
    change = _change(quantity, one, other, seed)
    test = ks_2samp(one, other)
    return FigureCompared(
        quantity, *values, change, scale, float(test.statistic), float(test.pvalue), _verdict(quantity, change, scale)
    )


def _change(
    quantity: Quantity, one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], seed: int
) -> tuple[float, float, float]:
    if quantity.summed == "spread":
        # Deviations from the mean of the images themselves: the mean's own error is of second order.
        squares = [np.square(values - values.mean()) for values in (one, other)]
        ratio = independent(squares[0], squares[1], seed)[0].ratio
        return ratio[0] ** 0.5, ratio[1] ** 0.5, ratio[2] ** 0.5
    found = {compared.statistic: compared for compared in independent(one, other, seed)}[quantity.summed]
    return found.difference if quantity.signed else found.ratio


def _verdict(quantity: Quantity, change: tuple[float, float, float], scale: float) -> Verdict | None:
    if not np.isfinite(change[0]):
        return None
    low, high = (-TOLERANCE * scale, TOLERANCE * scale) if quantity.signed else (1 / (1 + TOLERANCE), 1 + TOLERANCE)
    within = low <= change[0] <= high
    sure = low <= change[1] and change[2] <= high if within else change[2] < low or change[1] > high
    return ("yes" if sure else "yes?") if within else ("no" if sure else "no?")


def sentence(compared: FigureCompared, names: tuple[str, str]) -> str:
    """Return in one sentence whether a figure of the one is what it is in the other."""
    quantity, (value, low, high) = compared.quantity, compared.change
    head = f"{quantity.title}: {compared.one:.3g} in {names[0]}, {compared.other:.3g} in {names[1]}"
    if quantity.signed:
        told = f"{value:+.3f} apart ({low:+.3f} to {high:+.3f}), {abs(value) / compared.scale:.0%} of its spread there"
        told = told if compared.scale > 0 else f"{value:+.3f} apart ({low:+.3f} to {high:+.3f})"
    else:
        told = f"{value:.2f} times as much ({low:.2f} to {high:.2f})"
    match compared.verdict:
        case None:
            return f"{head}: no ratio to a figure that is 0."
        case "yes":
            return f"{head}: {told}, within {TOLERANCE:.0%}."
        case "yes?":
            return f"{head}: {told}, within {TOLERANCE:.0%}, but other images might not be."
        case "no?":
            return f"{head}: {told}, not within {TOLERANCE:.0%}, but other images might be."
        case "no":
            return f"{head}: {told}, not within {TOLERANCE:.0%}."
