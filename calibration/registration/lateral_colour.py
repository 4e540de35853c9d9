"""Lateral chromatic aberration: where red and blue see a point of the print against green.

A lens magnifies colours otherwise, and bends them otherwise: red and blue lie a ρ + b ρ³ further out than green, at ρ
of the way from the frame's middle to its corner. The linear term is the chromatic difference of magnification, the
cubic one that of distortion (W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 10). Measured with the cells'
map: what a channel alone would move blocks of cells by, against what all channels together would.

Half-size pixels, x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from experiment.framing.planes import CHANNELS, Channel

_USUAL_PX = 2.0
"""Shift at the frame's corner by which a term is taken to be 0 before it is measured: lenses have 0 to 1 px. It decides
only under lights that leave a channel dark."""

_MODEL_PX = 0.01
"""Standard error of each term that no number of cells takes away: what the model of the colours leaves is alike over
the frame (simulated frames: .003 to .009 px at the corner without aberration, .02 in a dim light)."""

_ROUNDS = 4
"""Reweighted least squares: blocks that are covered, or whose colours the model misses, end with little weight."""

_HUBER = 2.0
"""Usual misfits beyond which a block counts less."""

_ONE_DIRECTION = 1e-9
"""Share of the larger eigenvalue of an information below which the smaller is rounding, and none."""

_MEDIAN_CHI2 = 3.357
"""Median of χ² with 4 degrees of freedom: two colours, two directions."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LateralColour:
    """How far out red and blue lie against green.

    - `centre_px`: (2,) float64, the frame's middle.
    - `radius_px`: half the frame's diagonal.
    - `terms_px`: (2, 2) float64, of red and of blue: the linear and the cubic term at the frame's corner. Zeros until
      measured.
    - `covariance_px2`: (4, 4) float64 of `terms_px`, row by row.
    """

    centre_px: _Array
    radius_px: float
    terms_px: _Array
    covariance_px2: _Array

    @classmethod
    def unmeasured(cls, frame_size: tuple[int, int]) -> LateralColour:
        """Return none at all, as uncertain as a lens is before it is seen; `frame_size` is width and height."""
        size = np.array(frame_size, dtype=np.float64)
        return cls((size - 1) / 2, float(np.hypot(*size)) / 2, np.zeros((2, 2)), np.eye(4) * _USUAL_PX**2)

    def shift_px(self, places_px: _Array, channel: Channel) -> _Array:
        """Return how far out (N, 2) float64 px the channel sees what green sees at places (N, 2)."""
        if channel == "G":
            return np.zeros_like(places_px)
        linear, cubic = self.terms_px[0 if channel == "R" else 1]
        away = (places_px - self.centre_px) / self.radius_px
        return away * (linear + cubic * (away**2).sum(axis=-1, keepdims=True))

    def seen_px(self, places_px: _Array) -> _Array:
        """Return where red, green and blue see what green sees at places (N, 2) px, (3, N, 2) float64 px."""
        return np.stack([places_px + self.shift_px(places_px, channel) for channel in CHANNELS])

    def corner_px(self, channel: Channel) -> float:
        """Return the shift at the frame's corner, half-size px, outwards positive."""
        return 0.0 if channel == "G" else float(self.terms_px[0 if channel == "R" else 1].sum())

    def corner_error_px(self, channel: Channel) -> float:
        """Return the standard error of `corner_px`; that of a lens never seen where the channel is dark."""
        if channel == "G":
            return 0.0
        own = slice(0, 2) if channel == "R" else slice(2, 4)
        return float(np.sqrt(self.covariance_px2[own, own].sum()))

    def remeasured(self, places_px: _Array, information: _Array, pull: _Array) -> LateralColour:
        """Return the shifts most likely once blocks were compared channel by channel.

        Whatever all channels share, block by block, is left to the map: it is eliminated, not assumed.

        `places_px`: (B, 2) float64, the blocks' middles. `information`: (3, B, 2, 2) float64 px⁻², of red, green and
        blue: inverse covariance of the displacement that each alone measures; 0 where nothing was seen. `pull`: (3, B,
        2) float64 px⁻¹, information times that displacement, from where the channels are taken to be now.
        """
        total: _Array = information.sum(axis=0)
        # What one colour alone shows says nothing of others.
        seen = (np.trace(information, axis1=2, axis2=3) > 0).sum(axis=0) > 1
        if not seen.any():
            return self
        places, own, by = places_px[seen], information[:, seen], pull[:, seen]
        # A point of an edge is known across it alone.
        inverse = np.asarray(np.linalg.pinv(total[seen], rcond=_ONE_DIRECTION, hermitian=True), dtype=np.float64)
        away = (places - self.centre_px) / self.radius_px
        design = np.stack([away, away * (away**2).sum(axis=1, keepdims=True)], axis=-1)
        colours = [CHANNELS.index("R"), CHANNELS.index("B")]
        # Of red and blue what is left of their information when the map is free: a Schur complement.
        left = np.empty((len(places), 2, 2, 2, 2))
        for i, one in enumerate(colours):
            for j, other in enumerate(colours):
                left[:, i, j] = -np.einsum("nij,njk,nkl->nil", own[one], inverse, own[other])
            left[:, i, i] += own[one]
        free: _Array = np.einsum("nij,nj->ni", inverse, by.sum(axis=0))
        right = np.stack([by[one] - np.einsum("nij,nj->ni", own[one], free) for one in colours], axis=1)
        # Misfits are judged by what is left of them in units of their own error.
        spread = np.linalg.pinv(left.transpose(0, 1, 3, 2, 4).reshape(-1, 4, 4), hermitian=True)
        weight, scale = np.ones(len(places)), 1.0
        terms = before = self.terms_px.ravel()
        covariance = self.covariance_px2
        for _ in range(_ROUNDS):
            normal: _Array = np.einsum("n,nip,nabij,njq->apbq", weight, design, left, design).reshape(4, 4) / scale
            towards: _Array = np.einsum("n,nip,nai->ap", weight, design, right).ravel() / scale
            prior = np.eye(4) / _USUAL_PX**2
            covariance = np.linalg.inv(normal + prior)
            step = covariance @ (towards - prior @ before)
            terms = before + step
            moved: _Array = np.einsum("nip,ap->nai", design, step.reshape(2, 2))
            explained: _Array = np.einsum("nabij,nbj->nai", left, moved)
            misfit = (right - explained).reshape(-1, 4)
            chi2: _Array = np.einsum("ni,nij,nj->n", misfit, spread, misfit)
            scale = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)
            weight = np.minimum(1.0, _HUBER * np.sqrt(4 * scale / np.maximum(chi2, 1e-9)))
        return replace(self, terms_px=terms.reshape(2, 2), covariance_px2=covariance + np.eye(4) * _MODEL_PX**2)
