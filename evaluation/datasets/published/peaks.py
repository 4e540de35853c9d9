"""The largest value of an image as the threshold of clipping, where a data set states no other.

The authors of Cube and Cube+ (https://ipg.fer.hr/ipg/resources/color_constancy, N. Banić, K. Koščević, S. Lončarić,
"Unsupervised learning for color constancy", arXiv:1712.00436) looked at histograms of their images and advise, for an
image whose largest value in any channel is m, to discard every pixel with a channel from m - 2. (That page itself was
not at hand; two independent public preprocessing programs apply this rule.)
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from evaluation.datasets.raw_scene import Mask, RawScene, decode_image, subtract_black
from evaluation.scene import Image

BELOW_PEAK = 2
"""The authors' advice, see above: the two values below an image's largest count as clipped too."""

PEAK_RULE = (
    "in each image from m - 2, m its largest value in any channel (advice of the authors of Cube+, "
    "ipg.fer.hr/ipg/resources/color_constancy)"
)
"""The rule in the words of a treatment."""


@dataclass(frozen=True)
class Peaks:
    """The largest values of images that were read, so that asking for a saturation reads none a second time."""

    _known: dict[str, float] = field(default_factory=dict[str, float])

    def learn(self, path: str, image: Image) -> None:
        """Keep the largest value of an image (H, W, 3) of any dtype, as it is in its file."""
        self._known[path] = float(np.max(image))

    def of(self, path: str) -> float:
        """Return the largest value of the image in a file, which is read if it was not before."""
        if path not in self._known:
            self.learn(path, decode_image(path))
        return self._known[path]


@dataclass(frozen=True, slots=True)
class PeakScene(RawScene):
    """An image whose saturation is taken from its own largest value unless `white` is given.

    `peaks`: of all images of the data set.
    """

    peaks: Peaks = field(default_factory=Peaks)

    @property
    def saturation(self) -> float:
        """Value from which a pixel is clipped, in the units that `read` gives; reads the image if nothing did yet."""
        white = self.peaks.of(self.path) - BELOW_PEAK if self.white is None else self.white
        return white - self.black

    def read(self) -> tuple[Image, Mask | None]:
        """Return the image (H, W, 3), linear camera RGB with black at 0, and its mask (H, W) bool or None."""
        image = decode_image(self.path)
        if self.white is None:
            self.peaks.learn(self.path, image)
        lower = subtract_black(image, self.black)
        return lower, self.mask(lower)
