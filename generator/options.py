"""The options of the command `generate`: a frozen dataclass for each panel of its help, and the values they give.

Libraries that take long to load are imported when a group makes something of its options.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from foundation.compiled import processor_count
from foundation.console import option
from foundation.errors import InputError

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.dataset.making import Workers
    from generator.dataset.plan import DatasetOptions
    from generator.dataset.records import Description
    from generator.lights.lighting import LightChoice
    from generator.pictures.sources import Preparation, Source
    from generator.rendering import Rendering
    from generator.variation.variation import Variation


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
    random_scenes: Annotated[
        str | None,
        _source_option("N", "Add N pictures of uniformly random colours, 512x512 px; of another size as N:WxH."),
    ] = None
    max_side: Annotated[int | None, _source_option("PX", "Make larger pictures this small first.", min=1)] = None
    crop: Annotated[
        str | None,
        _source_option(
            "WxH",
            "Cut pictures to this size; smaller ones are left out. WxH,cover first makes pictures as small as still "
            "covers the crop. One crop is cut from the centre, or with WxH,random from a place that the seed chooses.",
        ),
    ] = None
    crops: Annotated[
        int,
        _source_option("N", "Cut N different crops of each picture, at random places far from each other.", min=1),
    ] = 1

    def preparation(self, seed: int) -> Preparation:
        """Return what is done to each picture; an InputError names the option that cannot be used."""
        from generator.pictures.sources import Preparation

        if self.crop is None:
            return Preparation(self.max_side, seed=seed, crops=self.crops)
        size, *words = self.crop.split(",")
        unknown = [word for word in words if word not in ("cover", "random")]
        if unknown:
            raise InputError(f"--crop {self.crop} has {unknown[0]!r}, expected cover or random behind the size")
        return Preparation(
            self.max_side,
            _size(size, "--crop"),
            cover="cover" in words,
            crop_at="random" if "random" in words else None,
            seed=seed,
            crops=self.crops,
        )

    def find(self, preparation: Preparation) -> tuple[Source, ...]:
        """Return the sources: pictures that are found, then random ones."""
        from generator.pictures.random_scenes import random_scenes
        from generator.pictures.sources import find_pictures

        places = self.sources or []
        if not places and (preparation.crop or preparation.max_side):
            raise InputError(
                "--crop, --crops and --max-side are for pictures, and --sources names none; random ones have a size, "
                "as in --random-scenes 8:256x256"
            )
        found: tuple[Source, ...] = find_pictures(places, preparation)
        if self.random_scenes is not None:
            if preparation.crops > 1:
                raise InputError("--crops is for pictures; leave --random-scenes out, or make a dataset of them alone")
            number, _, size = self.random_scenes.partition(":")
            if not re.fullmatch(r"[1-9]\d{0,8}", number, re.ASCII):
                raise InputError(
                    f"--random-scenes is {self.random_scenes!r}, expected a number such as 8, or 8:256x256"
                )
            found += random_scenes(int(number), *_size(size or "512x512", "--random-scenes"), preparation.seed)
        if not found:
            raise InputError("there is no source picture; name some with --sources or ask for --random-scenes")
        return found


@dataclass(frozen=True)
class LightOptions:
    """Which lights fall on which picture, and where."""

    light: Annotated[
        list[str] | None,
        _light_option(
            "LIGHT",
            "A light for every picture: numbers of the table's, 0,5,12-20 or all; a mixture of them, 12:0.25+40:0.75; "
            "5600K; a name such as D65 where the table's lights have names; or a chromaticity r=.3,b=.25. May be "
            "repeated.",
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
        Path | None,
        _light_option(
            "GT.csv",
            "The same with a mixture of lights that matches the ground truth; where the table cannot make it, with the "
            "nearest that it can, unless that is too far off.",
        ),
    ] = None
    lights_per_image: Annotated[
        int | None, _light_option("K", "Let K lights fall on each image. \\[default: 1; 2 with --masks]")
    ] = None
    lights_of: Annotated[
        str | None,
        _light_option(
            "DATASET",
            "Make the scenes of this dataset under the same lights for another camera, whose table LUT has the same "
            "lights; --sources names the same pictures, which are prepared in the same way.",
        ),
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

    def choose(self, lut: Lut, seed: int) -> LightChoice:
        """Return the choice of lights; an InputError names the option that cannot be used."""
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
        choice = self._lights(lut, seed, together)
        if together == 1:
            return choice
        return SimultaneousLights(choice, together, parse_masks(self.masks or "smooth", together, seed))

    def _lights(self, lut: Lut, seed: int, together: int) -> LightChoice:
        """Return the choice of lights with as many for each picture as its images have together."""
        from generator.lights import choices
        from generator.lights.distributions import ground_truths_by_line, load_ground_truths, parse_distribution
        from generator.lights.gamut import Gamut
        from generator.lights.lighting import RandomLights

        ways = {
            "--light": bool(self.light),
            "--nearest": self.nearest is not None,
            "--match": self.match is not None,
            "--distribution": self.distribution is not None,
            "--random": self.random is not None and self.distribution is None,
        }
        given = [name for name, is_given in ways.items() if is_given]
        if len(given) > 1:
            raise InputError(
                f"{' and '.join(given)} were both given; give one of them (only --random may go with --distribution)"
            )
        count = together * (1 if self.random is None else self.random)
        if self.light:
            return choices.parse_lights(self.light, lut)
        if self.nearest is not None:
            return choices.nearest_lights(lut, load_ground_truths(self.nearest), self.nearest.name, together)
        if self.match is not None:
            return choices.matched_lights(Gamut.of(lut), ground_truths_by_line(self.match), self.match.name, together)
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
        self, shard_images: int, reading: Mapping[str, Any], variation: Variation | None, crops: int
    ) -> DatasetOptions:
        """Return the options of the dataset; an InputError names the option that cannot be used."""
        from generator.dataset.plan import DatasetOptions, parse_split

        return DatasetOptions(
            form=self.format,
            layout=self.layout,
            previews=self.preview,
            split=None if self.split is None else parse_split(self.split),
            uncertainty=self.uncertainty,
            shard_images=shard_images,
            variation=variation,
            crops=crops,
            reading=reading,
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
            "The print's own black: keep it, compensate for it (take it out), or take out a random share of it of each "
            "image, random or random:MAX. The ground truth stays.",
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

    def variation(self, lut: Lut) -> Variation | None:
        """Return the variation of images of a table, or None."""
        from generator.variation.iso_speed import parse_iso, recorded_speed
        from generator.variation.variation import parse_exposure, parse_gradient, variation_of

        exposure = None if self.exposure is None else parse_exposure(self.exposure)
        gradient = None if self.gradient is None else parse_gradient(self.gradient)
        iso = None if self.iso is None else parse_iso(self.iso, *recorded_speed(lut))
        if exposure is None and gradient is None and iso is None:
            return None
        return variation_of(lut, exposure, gradient, iso)


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
        _work_option(
            "I/N",
            "Make share I of N only, I from 0, beside other programs that make theirs; then run the command without "
            "it.",
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


def _size(text: str, name: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if not match:
        raise InputError(f"{name} is {text!r}, expected width x height such as 512x512")
    return int(match[1]), int(match[2])


@dataclass(frozen=True)
class Chosen:
    """Sources and lights of a dataset.

    - `sources`, `choice`: the sources and the lights.
    - `reading`: how sources were read, as plain values.
    - `lines`: lines to print about the choice.
    - `crops`: crops of each picture.
    """

    sources: tuple[Source, ...]
    choice: LightChoice
    reading: Mapping[str, Any]
    lines: tuple[str, ...]
    crops: int


def choose(lut: Lut, pictures: PictureOptions, light: LightOptions, seed: int) -> Chosen:
    """Return the sources and lights that the options ask for."""
    from generator.lights.choices import light_notes

    if light.lights_of is not None:
        return _same_scenes(lut, light.lights_of, pictures, light)
    preparation = pictures.preparation(seed)
    sources = pictures.find(preparation)
    choice = light.choose(lut, seed)
    return Chosen(sources, choice, preparation.describe(), light_notes(choice), preparation.crops)


def _same_scenes(lut: Lut, place: str, pictures: PictureOptions, light: LightOptions) -> Chosen:
    from generator.dataset.reader import open_dataset
    from generator.dataset.same_lights import lights_of, scenes_of

    if replace(light, lights_of=None) != LightOptions():
        raise InputError(f"--lights-of {place} gives the lights, and so does another option; leave one out")
    dataset = open_dataset(place)
    preparation = _prepared_as(pictures, dataset.description, place)
    found = pictures.find(preparation) if pictures.sources else ()
    sources = scenes_of(dataset, found)
    reading = {**preparation.describe(), "lights_of": {"pictures_seed": preparation.seed}}
    lines = tuple(
        f"{place} was made with {name.replace('_', ' ')}; here the options decide"
        for name in ("variation", "rendering", "black_point")
        if name in dataset.description.options
    )
    return Chosen(sources, lights_of(dataset, lut), reading, lines, preparation.crops)


def _prepared_as(pictures: PictureOptions, made: Description, place: str) -> Preparation:
    """Return the preparation of a dataset's pictures; an InputError if the options give another one."""
    from generator.dataset.same_lights import preparation_of
    from generator.pictures.sources import UNPREPARED

    if pictures.random_scenes:
        raise InputError(
            f"--lights-of {place} gives the pictures; leave --random-scenes out, those of it are made again"
        )
    prepared = preparation_of(made)
    given = pictures.preparation(prepared.seed)
    if given.describe() not in (prepared.describe(), UNPREPARED.describe()):
        raise InputError(
            f"--max-side, --crop and --crops prepare pictures in another way than those of {place}; leave them out, "
            "pictures are prepared as there"
        )
    return prepared
