"""Render one picture under one illuminant of a look-up table (LUT), by colour or by codes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, get_args

import numpy as np
import numpy.typing as npt

from calibration.table.lut import require_lut
from foundation.errors import InputError
from generator.kernels.choice import check_picture
from generator.kernels.mixing import mix_samples
from generator.kernels.rendering import draw_samples
from generator.kernels.unfit import replace_unfit_colours
from generator.lights.choices import listed_lights
from generator.masks.making import checked_weights
from generator.rendering import DEFAULT, Rendering
from generator.rendering.colorimetric import rendering_with
from generator.rendering.matrices import matrix_for

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.lights.lighting import Mixture


def render(
    lut: Lut,
    picture: npt.NDArray[np.uint8],
    light: int | str | Mixture | None = None,
    *,
    lights: Sequence[int | str | Mixture] | None = None,
    weights: npt.ArrayLike | None = None,
    rendering: Rendering = DEFAULT,
    seed: int = 0,
    image: int = 0,
    threads: int = 1,
) -> npt.NDArray[np.uint16]:
    """Return the raw linear image of a print of `picture` under one illuminant, or several with a map of weights.

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
    lights
        K illuminants instead of `light`, each in one of these forms.
    weights
        (H, W, K), numbers ≥ 0 of any type and byte order: weight of each illuminant in each pixel. Each pixel needs a
        weight above 0. Weights are divided by their sum and rounded to multiples of 1/65535, like the masks of a data
        set. May be omitted if K is 1.
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
        If the LUT has no such illuminant, the rendering is unknown, `lut` or `picture` has the wrong type, weights are
        missing or invalid, or both or neither of `light` and `lights` are given.
    QualityError
        If the print has no contrast under the illuminant, so that rendering by colour is impossible.

    Examples
    --------
    >>> from generator import open_lut, read_picture
    >>> lut, picture = open_lut("lut"), read_picture("cat.png")
    >>> image = render(lut, picture, light=3, seed=1)
    >>> image.shape == picture.shape, image.dtype
    (True, dtype('uint16'))

    Illuminant 1 from the left, illuminant 3 from the right:

    >>> right = np.broadcast_to(np.linspace(0, 1, picture.shape[1]), picture.shape[:2])
    >>> mixed = render(lut, picture, lights=[1, 3], weights=np.stack([1 - right, right], axis=2))
    >>> bool((mixed[:, 0] == render(lut, picture, light=1)[:, 0]).all())
    True
    """
    require_lut(lut)
    check_picture(picture)
    if rendering not in get_args(Rendering):
        raise InputError(f"the rendering is {rendering!r}, expected one of {', '.join(get_args(Rendering))}")
    mixtures = _mixtures(lut, light, lights)
    shares = None
    if weights is not None:
        shares = checked_weights(weights, (*picture.shape[:2], len(mixtures)))
    elif len(mixtures) > 1:
        raise InputError(
            f"{len(mixtures)} illuminants have no weights, expected weights={(*picture.shape[:2], len(mixtures))}: "
            "height, width, illuminants; for one mixture in the whole picture, use light='12:0.25+40:0.75'"
        )
    if len(mixtures) == 1:
        shares = None
    white_level = lut.provenance.white_level
    if rendering == "codes":
        fit_picture, _ = replace_unfit_colours(picture, lut.provenance)
        tables = [mixture.samples(lut, seed, fit_picture) for mixture in mixtures]
        if shares is None:
            return draw_samples(tables[0], fit_picture, seed=seed, image=image, threads=threads)
        return mix_samples(
            tables, fit_picture, shares, white_level=white_level, seed=seed, image=image, threads=threads
        )
    by_colour = rendering_with(lut, matrix_for(lut))
    return by_colour.draw(
        picture, mixtures, weights=shares, white_level=white_level, seed=seed, image=image, threads=threads
    )


def _mixtures(
    lut: Lut, light: int | str | Mixture | None, lights: Sequence[int | str | Mixture] | None
) -> list[Mixture]:
    chosen = lights if light is None else [light]
    if chosen is None or (light is not None and lights is not None):
        given = "neither light nor lights is" if chosen is None else "both light and lights are"
        raise InputError(f"{given} given, expected one of them, such as light=3, or lights=[3, 5] with weights")
    choice = listed_lights(chosen, lut)
    if not choice.lights:
        raise InputError("lights is empty, expected 1 or more illuminants, such as [3, 5]")
    return [lighting.mixtures[0] for lighting in choice.lightings_of(0)]
