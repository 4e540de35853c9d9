"""Render one picture under one illuminant of a look-up table (LUT), by colour or by codes."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

import numpy as np
import numpy.typing as npt

from calibration.table.lut import require_lut
from foundation.errors import InputError
from generator.kernels.choice import check_picture
from generator.kernels.rendering import draw_samples
from generator.kernels.unfit import replace_unfit_colours
from generator.lights.choices import light_of
from generator.rendering import DEFAULT, Rendering
from generator.rendering.colorimetric import rendering_with
from generator.rendering.matrices import matrix_for

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.lights.lighting import Mixture


def render(
    lut: Lut,
    picture: npt.NDArray[np.uint8],
    light: int | str | Mixture,
    *,
    rendering: Rendering = DEFAULT,
    seed: int = 0,
    image: int = 0,
    threads: int = 1,
) -> npt.NDArray[np.uint16]:
    """Return the raw linear image of a print of `picture` under the illuminant `light`.

    The result is equal to image number `image` of a data set from `generate` with the same seed. That data set must use
    whole pictures and keep the print's black.

    Parameters
    ----------
    lut
        LUT, from `calibration.table.lut.open_lut`.
    picture
        (H, W, 3) uint8, sRGB codes, from `pictures.sources.read_picture` or any array.
    light
        Illuminant: its index in the LUT; a text as for the option ``--light``, such as ``"D65"``, ``"5600K"`` or
        ``"12:0.25+40:0.75"``; or a mixture from `lights.choices.parse_light`, whose ``white(lut)`` is the ground truth.
    rendering
        ``"colorimetric"``: the camera records the colours of the picture; the first use of a LUT takes seconds.
        ``"codes"``: the print has the codes of the picture, as in the paper. Colours that the LUT lists as unfit are
        replaced by the nearest fit colour.
    seed, image, threads
        As for `kernels.rendering.draw_samples`.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, linear camera RGB in counts; `lut.provenance.white_level` is the saturation level.

    Raises
    ------
    InputError
        If the LUT has no such illuminant, the rendering is unknown, or `lut` or `picture` has the wrong type.
    QualityError
        If the print has no contrast under the illuminant, so that rendering by colour is impossible.

    Examples
    --------
    >>> from generator import open_lut, read_picture
    >>> lut, picture = open_lut("lut"), read_picture("cat.png")
    >>> image = render(lut, picture, light=3, seed=1)
    >>> image.shape == picture.shape, image.dtype
    (True, dtype('uint16'))
    """
    require_lut(lut)
    check_picture(picture)
    if rendering not in get_args(Rendering):
        raise InputError(f"the rendering is {rendering!r}, expected one of {', '.join(get_args(Rendering))}")
    mixture = light_of(light, lut)
    if rendering == "codes":
        fit_picture, _ = replace_unfit_colours(picture, lut.provenance)
        samples = mixture.samples(lut, seed, fit_picture)
        return draw_samples(samples, fit_picture, seed=seed, image=image, threads=threads)
    by_colour, white_level = rendering_with(lut, matrix_for(lut)), lut.provenance.white_level
    return by_colour.draw(picture, [mixture], white_level=white_level, seed=seed, image=image, threads=threads)
