"""The options of `generate` that make a dataset like a real one, or like another camera's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from foundation.console import option
from foundation.errors import InputError
from generator.command.options import LightOptions, PictureOptions, VariationOptions

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from calibration.table.lut import Lut
    from generator.dataset.plan import DatasetOptions
    from generator.lights.lighting import LightChoice
    from generator.likeness.real_data import BlackShares, DrawnPictures
    from generator.pictures.sources import Source
    from generator.statistics import RealStatistics
    from generator.variation.variation import ExposureChoice

_likeness_option = partial(option, panel="Likeness")

PARTS: Final = ("lights", "pictures", "exposure", "size")
"""What of a real data set can be followed."""


@dataclass(frozen=True)
class LikenessOptions:
    """What the dataset is to be like."""

    like: Annotated[
        Path | None,
        _likeness_option(
            "STATS.json",
            "Make the dataset like the real one that evaluate describe --out wrote this of: lights drawn from a "
            "density of its lights, pictures drawn by weights that bring luminance, chroma and grey-world offsets to "
            "its own, exposures drawn from its exposures, and images cut to its most frequent size. Prints how far "
            "that went.",
        ),
    ] = None
    like_in: Annotated[
        str | None,
        _likeness_option(
            "LIST",
            "In which of lights,pictures,exposure,size. \\[default: in all that no other option says]",
        ),
    ] = None
    draw: Annotated[
        int | None,
        _likeness_option("N", "Draw N pictures, some several times. \\[default: as many as are found]", min=1),
    ] = None
    lights_of: Annotated[
        str | None,
        _likeness_option(
            "DATASET",
            "Make the scenes of this dataset under the same lights for another camera, whose table LUT has the same "
            "lights; --sources names the same pictures, which are prepared in the same way.",
        ),
    ] = None


@dataclass(frozen=True)
class Chosen:
    """Sources and lights of a dataset, and what is recorded and printed of how they were chosen.

    - `sources`, `choice`: the sources and the lights.
    - `reading`: how sources were read, as plain values.
    - `lines`: lines to print.
    - `crops`: crops of each picture.
    - `weighted`: whether sources were drawn by weights.
    - `exposure`: how images are exposed; None as the table.
    """

    sources: tuple[Source, ...]
    choice: LightChoice
    reading: Mapping[str, Any]
    lines: tuple[str, ...] = ()
    crops: int = 1
    weighted: bool = False
    exposure: ExposureChoice | None = None


def choose(
    lut: Lut,
    likeness: LikenessOptions,
    pictures: PictureOptions,
    light: LightOptions,
    variation: VariationOptions,
    rendered: DatasetOptions,
    seed: int,
    workers: int,
) -> Chosen:
    """Return the sources and lights that the options ask for."""
    parts = [] if likeness.like is None else _parts(likeness, pictures, light, variation)
    if rendered.black_point.kind == "like" and "pictures" not in parts:
        raise InputError(
            "--black-point like draws pictures with the shadows of real images; give --like STATS.json, with pictures "
            "in --like-in if that is given, or another black point"
        )
    if likeness.lights_of is not None:
        if likeness.like is not None:
            raise InputError("--like and --lights-of were both given; the second takes pictures and lights as they are")
        _refuse_more(likeness)
        return _same_scenes(lut, likeness.lights_of, pictures, light)
    if likeness.like is None:
        _refuse_more(likeness)
        sources = pictures.find(seed)
        choice = light.request().choose(lut, seed, [source.name for source in sources], pictures.crops)
        return Chosen(sources, choice, pictures.preparation(seed).describe(), crops=pictures.crops)
    return _like(lut, likeness, likeness.like, parts, pictures, light, rendered, seed, workers)


def _refuse_more(likeness: LikenessOptions) -> None:
    """Refuse what says more of `--like`, which is not given."""
    for name, given in (("--like-in", likeness.like_in), ("--draw", likeness.draw)):
        if given is not None:
            raise InputError(f"{name} {given} says what --like is to do; give --like STATS.json, or leave it out")


def _like(
    lut: Lut,
    likeness: LikenessOptions,
    path: Path,
    parts: list[str],
    pictures: PictureOptions,
    light: LightOptions,
    rendered: DatasetOptions,
    seed: int,
    workers: int,
) -> Chosen:
    from generator.likeness.real_data import (
        cautions,
        drawn_sources,
        exposure_sentence,
        light_caution,
        like_exposure,
        like_size,
        remedies,
    )
    from generator.statistics import read_statistics

    target = read_statistics(path)
    record: dict[str, Any] = {
        "file": target.file,
        "sha256": target.sha256,
        "data": target.name,
        "images": target.images,
        "in": parts,
    }
    lines = cautions(target)
    if "size" in parts:
        size = like_size(target, pictures.find(seed))
        if size is None:
            lines.append(f"size: {target.name} is of thumbnails, whose size is not followed; pictures keep theirs")
        else:
            pictures = replace(pictures, crop=f"{size.width}x{size.height}", cover=True)
            record["size"] = size.describe()
            lines.append(size.sentence())
    if "lights" in parts:
        light = replace(light, distribution=str(path))
        record["lights"], sentence = _lights_within(lut, target)
        lines.append(sentence)
    exposure = None
    if "exposure" in parts:
        exposure = like_exposure(target)
        if exposure is None and likeness.like_in is not None:
            raise InputError(
                f"{target.file} knows no exposure, since the saturation of {target.name} was not known; describe it "
                "with --saturation, or leave exposure out of --like-in"
            )
        lines.append(exposure_sentence(target))
    sources = pictures.find(seed)
    if "pictures" in parts:
        drawn = _drawn(lut, target, sources, rendered, likeness.draw, seed, workers)
        sources = drawn_sources(sources, drawn)
        record["pictures"] = drawn.describe()
        lines += [*drawn.sentences(), *remedies(drawn, rendered), light_caution(lut, target)]
    choice = light.request().choose(lut, seed, [source.name for source in sources], pictures.crops)
    reading = {**pictures.preparation(seed).describe(), "like": record}
    return Chosen(sources, choice, reading, tuple(lines), pictures.crops, "pictures" in parts, exposure)


def _parts(
    likeness: LikenessOptions, pictures: PictureOptions, light: LightOptions, variation: VariationOptions
) -> list[str]:
    """Return in what the dataset is to be like the real one."""
    said = {
        "lights": [
            name
            for name, given in (
                ("--illuminations", light.illuminations),
                ("--light", light.light),
                ("--distribution", light.distribution),
                ("--nearest", light.nearest),
                ("--match", light.match),
                ("--lights-by-name", light.lights_by_name),
            )
            if given
        ],
        "pictures": [],
        "exposure": [] if variation.exposure is None else ["--exposure"],
        "size": [name for name, given in (("--crop", pictures.crop), ("--max-side", pictures.max_side)) if given],
    }
    if likeness.like_in is None:
        parts = [part for part in PARTS if not said[part]]
    else:
        parts = list(dict.fromkeys(part.strip() for part in likeness.like_in.split(",")))
        for part in parts:
            if part not in PARTS:
                raise InputError(f"--like-in has {part!r}, expected some of {','.join(PARTS)}")
            if said[part]:
                raise InputError(f"{' and '.join(said[part])} says the {part}, and so does --like; leave one out")
    if likeness.draw is not None and "pictures" not in parts:
        raise InputError(f"--draw {likeness.draw} is for pictures, in which --like-in does not follow the real data")
    return parts


def _lights_within(lut: Lut, target: RealStatistics) -> tuple[dict[str, Any], str]:
    """Return how many of the target's lights a table can make, as a record and a sentence."""
    from generator.lights.gamut import TOLERANCE_DEG, Gamut

    gamut = Gamut.of(lut)
    # A light of the very table lies at its edge, and beyond by what a file rounds.
    beyond = target.lights[~gamut.contains(target.lights)]
    outside = sum(gamut.match(light, "nearest").angle > TOLERANCE_DEG for light in beyond) / len(target.lights)
    sentence = (
        f"lights: {outside:.1%} of the {len(target.lights)} of {target.name} lie outside what {lut.folder} can make"
    )
    if outside:
        sentence += "; others are drawn for them"
    return {"count": len(target.lights), "outside": float(f"{outside:.6g}")}, sentence


def _drawn(
    lut: Lut,
    target: RealStatistics,
    sources: tuple[Source, ...],
    rendered: DatasetOptions,
    count: int | None,
    seed: int,
    workers: int,
) -> DrawnPictures:
    """Return which pictures are drawn by what they look like under the light nearest to the target's."""
    from foundation.console import progress
    from generator.likeness.real_data import draw_pictures, measure_pictures, reference_light
    from generator.rendering.black_points import KEEP

    reference = reference_light(lut, target.lights)
    black = None
    if rendered.black_point.kind == "like":
        black = _black_under(lut, reference, rendered)
        rendered = replace(rendered, black_point=KEEP)
    photograph = partial(_photograph, lut, reference, rendered, seed)
    with progress("pictures") as shown:
        measured = measure_pictures(sources, photograph, lut.white[reference], target.cells, workers, shown, black)
    return draw_pictures(measured, target, count, seed)


def _black_under(lut: Lut, light: int, rendered: DatasetOptions) -> BlackShares:
    """Return the print's black under a light of the table; a QualityError where it is as bright as half of white."""
    from generator.dataset.making import rendering_of
    from generator.lights.lighting import plain
    from generator.likeness.real_data import BlackShares
    from generator.rendering.black_points import veil_of

    grey = None
    if rendered.rendering == "colorimetric":
        grey = rendering_of(lut, rendered).black(plain(light))
    red, green, blue = veil_of(lut, plain(light), 1.0, grey).taken.tolist()
    return BlackShares((red, green, blue))


def _photograph(
    lut: Lut, light: int, rendered: DatasetOptions, seed: int, picture: npt.NDArray[np.uint8], number: int
) -> npt.NDArray[np.uint16]:
    """Return the raw image of a picture as the dataset renders it, under one of the table's lights."""
    from generator.dataset.making import photograph
    from generator.kernels.choice import replace_unfit_colours
    from generator.lights.lighting import Lighting, plain
    from generator.pictures.sources import keep_bits

    picture = keep_bits(picture, rendered.bits)
    if rendered.rendering == "codes":
        picture, _ = replace_unfit_colours(picture, lut.provenance)
    white_level = lut.provenance.white_level
    return photograph(lut, picture, Lighting((plain(light),)), rendered, seed, number, white_level)[0]


def _same_scenes(lut: Lut, place: str, pictures: PictureOptions, light: LightOptions) -> Chosen:
    """Return the scenes of another dataset, under its lights."""
    from generator.likeness.same_lights import lights_of, open_scenes, scenes_of

    if light != LightOptions():
        raise InputError(f"--lights-of {place} says the lights, and so does another option; leave one out")
    dataset = open_scenes(place)
    prepared = _prepared_as(pictures, dataset.description.options, place)
    seed = dataset.description.seed
    found = prepared.find(seed) if prepared.sources else ()
    sources = scenes_of(dataset, found)
    reading = {**prepared.preparation(seed).describe(), "lights_of": {"pictures_seed": seed}}
    lines = [
        f"{place} was made with {name.replace('_', ' ')}; here it is what the options say"
        for name in ("variation", "rendering", "black_point")
        if name in dataset.description.options
    ]
    return Chosen(sources, lights_of(dataset, lut), reading, tuple(lines), prepared.crops)


def _prepared_as(pictures: PictureOptions, made: Mapping[str, Any], place: str) -> PictureOptions:
    """Return the options of pictures as a dataset was made with; an InputError if others are given."""
    if pictures.random_scenes:
        raise InputError(
            f"--lights-of {place} says the pictures; leave --random-scenes out, those of it are made again"
        )
    crop = made.get("crop")
    wanted: dict[str, Any] = {
        "max_side": made.get("max_side"),
        "crop": None if crop is None else "{}x{}".format(*crop),
        "cover": bool(made.get("cover", False)),
        "crop_at": made.get("crop_at"),
        "profiles": made.get("profiles", "honour"),
        "crops": int(made.get("crops", 1)),
    }
    plain = PictureOptions()
    for name, value in wanted.items():
        given = getattr(pictures, name)
        if given not in (value, getattr(plain, name)):
            raise InputError(
                f"--{name.replace('_', '-')} is {given}, where {place} was made with {value}; leave it out, pictures "
                "are prepared as there"
            )
    return replace(pictures, **wanted)
