"""One picture under one light of a table, by colour or by codes: the pixels of a dataset in one call."""

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
    """Return the raw linear image of `picture` printed, lit by `light` and photographed.

    It is image number `image` of the dataset that `generate` makes with the same seed, where that shows the whole
    picture and keeps the print's black.

    Parameters
    ----------
    lut
        A table, from `calibration.table.lut.open_lut`.
    picture
        (H, W, 3) uint8 sRGB codes, from `pictures.sources.read_picture` or any array.
    light
        Number of the light in the table; a text as the command's ``--light`` takes it, such as ``"D65"``, ``"5600K"``
        or ``"12:0.25+40:0.75"``; or a mixture that `lights.choices.parse_light` made of one, whose ``white(lut)`` is
        the ground truth.
    rendering
        ``"colorimetric"``: the print shows the camera the picture's colours; where in the chart they are takes seconds
        a table, once. ``"codes"``: a picture's codes are those of the print, as in the paper; colours that the table
        lists as unfit are replaced by the nearest fit one.
    seed, image, threads
        As for `kernels.rendering.draw_samples`.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, linear camera RGB, `lut.provenance.white_level` = saturation of the sensor.

    Raises
    ------
    InputError
        The table has no such light, there is no such rendering, or table or picture are none.
    QualityError
        The print has no contrast under the light, so that there is no rendering by colour.

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
        raise InputError(f"{rendering!r} is no rendering; use one of {', '.join(get_args(Rendering))}")
    mixture = light_of(light, lut)
    if rendering == "codes":
        fit, _ = replace_unfit_colours(picture, lut.provenance)
        samples = mixture.samples(lut, seed, fit)
        return draw_samples(samples, fit, seed=seed, image=image, threads=threads)
    by_colour, most = rendering_with(lut, matrix_for(lut)), lut.provenance.white_level
    return by_colour.draw(picture, [mixture], most=most, seed=seed, image=image, threads=threads)
