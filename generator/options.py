"""The options of the command `generate`: a frozen dataclass for each panel of its help, and what they come to.

The last of them make a dataset like a real one, or like another camera's. Libraries that take long to load are imported
when a group makes something of its options.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from foundation.compiled import processor_count
from foundation.console import AsJson, option, progress
from foundation.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from calibration.table.lut import Lut
    from generator.dataset.making import Workers
    from generator.dataset.plan import DatasetOptions
    from generator.lights.lighting import LightChoice
    from generator.likeness.real_data import BlackShares, DrawnPictures
    from generator.pictures.sources import Preparation, Source
    from generator.rendering import Rendering
    from generator.statistics import RealStatistics
    from generator.variation.variation import ExposureChoice, Variation


_source_option = partial(option, panel="Source pictures")
_light_option = partial(option, panel="Light")
_image_option = partial(option, panel="Images")
_variation_option = partial(option, panel="Variation")
_work_option = partial(option, panel="Work")


@dataclass(frozen=True)
class Places:
    """The arguments: the table, and the place of the dataset; None where an option needs neither."""

    lut: Annotated[
        Path | None,
        typer.Argument(
            metavar="LUT", help="Folder of the table; demo: for a small one to begin with.", show_default=False
        ),
    ] = None
    out: Annotated[
        str | None, typer.Argument(metavar="OUT", help="Folder or URL to make; must not exist.", show_default=False)
    ] = None


@dataclass(frozen=True)
class PictureOptions:
    """Which pictures are sources, and how they are prepared."""

    sources: Annotated[
        list[str] | None,
        _source_option(
            "PLACE",
            "A picture, or a folder that is searched with those below it, or a URL of either on a store that fsspec "
            "knows; may be repeated.",
        ),
    ] = None
    random_scenes: Annotated[int, _source_option("N", "Add N pictures of uniformly random colours.", min=0)] = 0
    size: Annotated[str, _source_option("WxH", "Size of the random pictures, px.")] = "512x512"
    max_side: Annotated[int | None, _source_option("PX", "Make larger pictures this small first.", min=1)] = None
    crop: Annotated[str | None, _source_option("WxH", "Cut pictures to this size; smaller ones are left out.")] = None
    cover: Annotated[
        bool,
        _source_option(None, "Make pictures as small as still covers the crop before they are cut.", "--cover"),
    ] = False
    crop_at: Annotated[
        Literal["centre", "random"] | None,
        _source_option(
            None,
            "Where to cut; random is chosen by the seed. Of several crops the first. \\[default: centre; random with "
            "--crops]",
        ),
    ] = None
    crops: Annotated[
        int,
        _source_option(
            "N",
            "Cut N different crops of each picture, the first where --crop-at says, the others at random places far "
            "from it and from each other.",
            min=1,
        ),
    ] = 1
    profiles: Annotated[
        Literal["honour", "ignore"],
        _source_option(
            None, "Convert pictures with another colour profile to sRGB, or take their codes as they stand."
        ),
    ] = "honour"

    def preparation(self, seed: int) -> Preparation:
        """Return what is done to each picture; an InputError says which option cannot be used."""
        from generator.pictures.sources import Preparation

        crop = None if self.crop is None else _size(self.crop, "--crop")
        return Preparation(self.max_side, crop, self.cover, self.crop_at, self.profiles, seed, self.crops)

    def find(self, seed: int) -> tuple[Source, ...]:
        """Return the sources: pictures that are found, then random ones."""
        from generator.pictures.random_scenes import random_scenes
        from generator.pictures.sources import find_pictures

        preparation = self.preparation(seed)
        places = self.sources or []
        if not places and (preparation.crop or preparation.max_side):
            raise InputError(
                "--crop, --crops and --max-side are for pictures, and --sources names none; random ones have --size"
            )
        found: tuple[Source, ...] = find_pictures(places, preparation)
        if self.random_scenes and self.crops > 1:
            raise InputError("--crops is for pictures; leave --random-scenes out, or make a dataset of them alone")
        if self.random_scenes:
            found += random_scenes(self.random_scenes, *_size(self.size, "--size"), seed)
        if not found:
            raise InputError("there is no source picture; name some with --sources or ask for --random-scenes")
        return found


@dataclass(frozen=True)
class LightOptions:
    """Which lights fall on which picture, and where."""

    illuminations: Annotated[str | None, _light_option("LIST", "These lights for every picture: 0,5,12-20 or all.")] = (
        None
    )
    light: Annotated[
        list[str] | None,
        _light_option(
            "LIGHT",
            "A light for every picture, mixed of the table's: 12, 12:0.25+40:0.75, 5600K, a name such as D65 where "
            "the table's lights have names, or a chromaticity r=.3,b=.25; may be repeated.",
        ),
    ] = None
    random: Annotated[
        int | None,
        _light_option(
            "K",
            "K images of each picture, under distinct random lights of the table, or under lights drawn from "
            "--distribution. \\[default: 1]",
        ),
    ] = None
    distribution: Annotated[
        str | None,
        _light_option(
            "NAME",
            "Draw chromaticities from uniform, gaussian:r=.3,b=.25,sd=.02 (or sd_r, sd_b and corr for sd), or a "
            "file of ground truths as of --nearest: the kernel density of its lights.",
        ),
    ] = None
    nearest: Annotated[
        Path | None,
        _light_option(
            "GT.csv",
            "For scene i, in the order of the pictures, the light nearest in angle to ground truth i of this file, "
            "which starts over when it ends (columns GT_R,GT_G,GT_B or r,g,b, or lines of three numbers).",
        ),
    ] = None
    match: Annotated[
        Path | None, _light_option("GT.csv", "The same with a mixture of lights that matches the ground truth.")
    ] = None
    lights_by_name: Annotated[
        Path | None,
        _light_option(
            "FILE.csv",
            "For each picture the light that this file gives for its name (columns source or name, and r,g,b), matched "
            "by a mixture; several rows of a name are several images.",
        ),
    ] = None
    outside: Annotated[
        Literal["refuse", "nearest"], _light_option(None, "What to do about lights that the table cannot make.")
    ] = "refuse"
    lights_per_image: Annotated[
        int | None, _light_option("K", "Let K lights fall on each image. \\[default: 1; 2 with --masks]")
    ] = None
    masks: Annotated[
        str | None,
        _light_option(
            "KIND",
            "Where each of several lights falls: half-plane or soft-edge (angle, width), spots (count, radius, "
            "softness), smooth (scale, contrast), window (columns, rows, softness), with numbers where wanted, as in "
            "spots:count=3,radius=.1; or a folder of masks. \\[default: smooth]",
        ),
    ] = None

    def choose(self, lut: Lut, seed: int, names: Sequence[str] = (), crops: int = 1) -> LightChoice:
        """Return the choice of lights for pictures of these names; an InputError says which option cannot be used."""
        from generator.lights.choices import SimultaneousLights
        from generator.masks.making import parse_masks

        together = self.lights_per_image or (1 if self.masks is None else 2)
        if self.lights_per_image is not None and self.lights_per_image < 1:
            raise InputError(f"{self.lights_per_image} lights an image were asked for, expected 1 or more")
        if self.masks is not None and together == 1:
            raise InputError(
                f"--masks {self.masks} says where several lights fall, but each image has one; ask for more with "
                "--lights-per-image"
            )
        choice = self._lights(lut, seed, together, names, crops)
        if together == 1:
            return choice
        return SimultaneousLights(choice, together, parse_masks(self.masks or "smooth", together, seed))

    def _lights(self, lut: Lut, seed: int, together: int, names: Sequence[str], crops: int) -> LightChoice:
        """Return the choice of lights with as many for each picture as its images have together."""
        from generator.lights import choices
        from generator.lights.distributions import load_ground_truths, parse_distribution
        from generator.lights.gamut import Gamut
        from generator.lights.lighting import ListedLights, RandomLights
        from generator.lights.named_lights import load_named_truths, named_lights

        ways = {
            "--illuminations": self.illuminations is not None,
            "--light": bool(self.light),
            "--nearest": self.nearest is not None,
            "--match": self.match is not None,
            "--lights-by-name": self.lights_by_name is not None,
            "--distribution": self.distribution is not None,
            "--random": self.random is not None and self.distribution is None,
        }
        given = [name for name, is_given in ways.items() if is_given]
        if len(given) > 1:
            raise InputError(
                f"{' and '.join(given)} were both given; give one of them (only --random may go with --distribution)"
            )
        count = together * (1 if self.random is None else self.random)
        if self.illuminations is not None:
            return choices.parse_lights(self.illuminations, len(lut.white))
        if self.light:
            gamut = Gamut.of(lut)
            return ListedLights(tuple(choices.parse_light(text, lut, gamut, self.outside) for text in self.light))
        if self.nearest is not None:
            return choices.nearest_lights(lut, load_ground_truths(self.nearest), self.nearest.name, together)
        if self.match is not None:
            truths = load_ground_truths(self.match)
            return choices.matched_lights(Gamut.of(lut), truths, self.match.name, together, self.outside)
        if self.lights_by_name is not None:
            truths_by_name, file = load_named_truths(self.lights_by_name), self.lights_by_name.name
            return named_lights(Gamut.of(lut), truths_by_name, names, file, self.outside, crops)
        if self.distribution is not None:
            return choices.DrawnLights(Gamut.of(lut), parse_distribution(self.distribution), count, seed)
        return RandomLights(count, len(lut.white), seed)


@dataclass(frozen=True)
class ImageOptions:
    """What is written, and the seed of everything random."""

    seed: Annotated[int, _image_option(None, "Seed of everything random.")] = 0
    format: Annotated[
        Literal["png", "tiff", "exr", "jxl", "dng"],
        _image_option(
            None,
            "PNG of 16 bits, of which Pillow and imageio keep 8 (read with cv2.IMREAD_UNCHANGED or open_dataset); "
            "uncompressed TIFF, fast and large; OpenEXR; JPEG XL, small; or raw files, Bayer DNG.",
        ),
    ] = "png"
    layout: Annotated[
        Literal["folder", "webdataset", "parquet"],
        _image_option(
            None,
            "Each image in a file of its own, or those of a shard in a tar file (WebDataset) or in a Parquet file "
            "(Hugging Face datasets).",
        ),
    ] = "folder"
    split: Annotated[
        str | None,
        _image_option(
            "SHARES",
            "Divide by source into train, validation and test, such as 0.8,0.1,0.1; two shares are train and test. By "
            "a hash of each picture, so that parts have these sizes on average.",
        ),
    ] = None
    exact_split: Annotated[
        bool,
        _image_option(
            None,
            "With --split, parts of exactly these sizes, such as 700,200,100 of 1000 pictures; copies of a "
            "picture stay in one part.",
            "--exact-split",
        ),
    ] = False
    bits: Annotated[
        int | None,
        _image_option(
            "N",
            "Keep N bits of each code of the pictures and set the others to zero before they are printed. "
            "\\[default: those of the table]",
            min=1,
            max=8,
        ),
    ] = None
    scale: Annotated[
        Literal["table", "full"],
        _image_option(
            None,
            "Store the camera's counts, which most programs show nearly black; or stretch them over 16 bits, which our "
            "readers undo (PNG, TIFF and JPEG XL).",
        ),
    ] = "table"
    preview: Annotated[bool, _image_option(None, "Write tone-mapped previews.")] = True
    uncertainty: Annotated[
        bool,
        _image_option(
            None,
            "Add to ground_truth.csv what each light's direction may be off by, in degrees (k = 2), as the table "
            "states it.",
        ),
    ] = False
    contact_sheet: Annotated[
        Path | None,
        _image_option("PATH", "Write a page of previews to this PNG file; with --verify of a dataset that is there."),
    ] = None

    def dataset_options(
        self,
        shard_images: int,
        reading: Mapping[str, Any],
        variation: Variation | None,
        crops: int,
        weighted: bool = False,
    ) -> DatasetOptions:
        """Return what the dataset is to be; an InputError says which option cannot be used."""
        from generator.dataset.plan import DatasetOptions, parse_split

        return DatasetOptions(
            form=self.format,
            layout=self.layout,
            previews=self.preview,
            split=None if self.split is None else parse_split(self.split),
            split_exact=self.exact_split,
            bits=self.bits,
            scale=self.scale,
            uncertainty=self.uncertainty,
            shard_images=shard_images,
            variation=variation,
            crops=crops,
            reading=reading,
            weighted=weighted,
        )


@dataclass(frozen=True)
class RenderingOptions:
    """How the codes of a picture become what the camera sees of its print."""

    rendering: Annotated[
        Literal["codes", "colorimetric"] | None,
        _image_option(
            None,
            "Print a picture so that it looks to the camera as its colours should; or take its codes as those of the "
            "print, as the paper did. \\[default: colorimetric; a dataset that was begun goes on as it was]",
        ),
    ] = None
    matrix: Annotated[
        str | None,
        _image_option(
            "NAME",
            "For colorimetric rendering: linear sRGB to the camera's RGB, of a camera by its name, of a file of 3 x 3 "
            "numbers, table for the one fitted from the table, or none. \\[default: that of the table's camera, else "
            "table]",
        ),
    ] = None
    black_point: Annotated[
        str,
        _image_option(
            "WHAT",
            "The print's own black: keep it, compensate for it (take it out), take out a random share of it of each "
            "image, random or random:MAX, or, with --like, of each picture the share that makes shadows like the real "
            "ones, like. The ground truth stays.",
        ),
    ] = "keep"

    def of(self, options: DatasetOptions, table: Lut, begun: Rendering | None) -> DatasetOptions:
        """Return the options of a dataset with these; an InputError says which cannot be used.

        `begun`: how the dataset is rendered that is there, or was begun; None for a new one.
        """
        from generator.rendering.black_points import parse_black_point
        from generator.rendering.matrices import matrix_for

        rendering = self.rendering or begun or options.rendering
        if rendering == "codes" and self.matrix is not None:
            raise InputError("--matrix is for --rendering colorimetric; add that, or leave --matrix out")
        matrix = matrix_for(table, self.matrix) if rendering == "colorimetric" else None
        return replace(options, rendering=rendering, matrix=matrix, black_point=parse_black_point(self.black_point))


@dataclass(frozen=True)
class VariationOptions:
    """What differs from image to image beside scene and light."""

    exposure: Annotated[
        str | None,
        _variation_option(
            "KIND",
            "Expose images anew: a factor such as .5; stops:low=-2,high=1 or normal:mean=-1,sd=.5, drawn for each; "
            "clip:share=.01 clips that share of the pixels, level:share=.01,low=.3,high=.9 lets it reach a level over "
            "saturation (most=8 limits the factor). Noise is that of the light, counts are cut at saturation.",
        ),
    ] = None
    gradient: Annotated[
        str | None,
        _variation_option(
            "KIND",
            "Let the light fall off over the image by up to some stops: smooth, soft-edge, spots or window with the "
            "numbers of --masks and stops=1,least=0,colour=0; with a colour, ln(R/G) and ln(B/G) of the far end differ "
            "by up to that, and images have masks and maps of the ground truth.",
        ),
    ] = None
    iso: Annotated[
        str | None,
        _variation_option(
            "N/BASE",
            "Add the noise of ISO speed N to that of the table, which was photographed with speed BASE: 1600/100, or "
            "1600/100:read=2.5, electrons of read noise before the amplifier. Tables that say their ISO speed need no "
            "BASE.",
        ),
    ] = None

    def variation(self, lut: Lut, like: ExposureChoice | None = None) -> Variation | None:
        """Return the variation of images of a table, exposed like a data set unless an option says how, or None."""
        from generator.variation.iso_speed import known_of_table, parse_iso
        from generator.variation.variation import parse_exposure, parse_gradient, varied_by

        exposure = like if self.exposure is None else parse_exposure(self.exposure)
        gradient = None if self.gradient is None else parse_gradient(self.gradient)
        iso = None if self.iso is None else parse_iso(self.iso, *known_of_table(lut))
        if exposure is None and gradient is None and iso is None:
            return None
        return varied_by(lut, exposure, gradient, iso)


@dataclass(frozen=True)
class WorkOptions:
    """Who does the work and which part of it."""

    workers: Annotated[
        int | None, _work_option("N", "Threads, or processes of the engine dask. \\[default: one a processor]")
    ] = None
    engine: Annotated[
        str,
        _work_option(
            "NAME",
            "local, dask (a cluster on this machine), or dask://HOST:PORT of a scheduler; docs/clusters.md.",
        ),
    ] = "local"
    shard_images: Annotated[
        int,
        _work_option("N", "Images of a shard: what a kill may cost of tar and Parquet files, and on a store.", min=1),
    ] = 256
    shard: Annotated[
        str | None,
        _work_option("I/N", "Make share I of N only, I from 0, beside other programs that make theirs; then --finish."),
    ] = None
    finish: Annotated[
        str | None,
        _work_option(
            "OUT",
            "Make the dataset OUT of its shards when all shares are done; no other argument is needed.",
        ),
    ] = None
    verify: Annotated[
        str | None,
        _work_option(
            "OUT",
            "Hash every file of the dataset OUT again and name those that have changed; no other argument is needed.",
        ),
    ] = None

    def makers(self) -> Workers:
        """Return who makes the images: as many as there are processors unless a number is given."""
        from generator.dataset.making import Workers

        return Workers(self.engine, processor_count() if self.workers is None else self.workers)


@dataclass(frozen=True)
class CommonOptions:
    """What commands with figures take."""

    as_json: AsJson = False


def _size(text: str, name: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if not match:
        raise InputError(f"{name} is {text!r}, expected width x height such as 512x512")
    return int(match[1]), int(match[2])


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
        choice = light.choose(lut, seed, [source.name for source in sources], pictures.crops)
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
    choice = light.choose(lut, seed, [source.name for source in sources], pictures.crops)
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
    from generator.dataset.shards import rendering_of
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
    from generator.dataset.shards import photograph
    from generator.kernels.unfit import replace_unfit_colours
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
