"""The options of the command `generate`: one frozen dataclass for each panel of the help.

Methods of the classes turn options into objects of the library. They import slow libraries only when they are called.
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
class PathArguments:
    """The arguments; None if they are missing, as with --verify."""

    lut: Annotated[
        Path | None,
        typer.Argument(metavar="LUT", help="Folder of the LUT, or demo: for a small example.", show_default=False),
    ] = None
    out: Annotated[
        str | None,
        typer.Argument(metavar="OUT", help="Folder or URL of the new data set; must not exist.", show_default=False),
    ] = None


@dataclass(frozen=True)
class PictureOptions:
    """Selection and preparation of the source pictures."""

    sources: Annotated[
        list[str] | None,
        _source_option(
            "PLACE",
            "A picture, a folder that is searched with its subfolders, or the URL of either on a store supported by "
            "fsspec; may be repeated.",
        ),
    ] = None
    random_scenes: Annotated[
        str | None,
        _source_option("N", "Add N pictures of uniformly random colours, 512x512 px; N:WxH selects another size."),
    ] = None
    max_side: Annotated[int | None, _source_option("PX", "Reduce larger pictures to this longest side.", min=1)] = None
    crop: Annotated[
        str | None,
        _source_option(
            "WxH",
            "Crop pictures to this size; smaller pictures are skipped. WxH,cover first reduces each picture until it "
            "just covers the crop. The crop is taken from the centre, or with WxH,random from a random position.",
        ),
    ] = None
    crops: Annotated[
        int,
        _source_option("N", "Take N different crops of each picture, at random positions far from each other.", min=1),
    ] = 1

    def preparation(self, seed: int) -> Preparation:
        """Return the preparation that the options select."""
        from generator.pictures.sources import Preparation

        if self.crop is None:
            return Preparation(self.max_side, seed=seed, crops=self.crops)
        size, *flags = self.crop.split(",")
        unknown = [flag for flag in flags if flag not in ("cover", "random")]
        if unknown:
            raise InputError(
                f"--crop {self.crop} contains {unknown[0]!r}, expected cover or random after the size; correct it"
            )
        return Preparation(
            self.max_side,
            _size(size, "--crop"),
            cover="cover" in flags,
            crop_at="random" if "random" in flags else None,
            seed=seed,
            crops=self.crops,
        )

    def find(self, preparation: Preparation) -> tuple[Source, ...]:
        """Return the pictures of --sources, followed by random pictures."""
        from generator.pictures.random_scenes import random_scenes
        from generator.pictures.sources import find_pictures

        locations = self.sources or []
        if not locations and (preparation.crop or preparation.max_side):
            raise InputError(
                "--crop, --crops and --max-side need pictures, but --sources is missing; add it, or give the size of "
                "random pictures as in --random-scenes 8:256x256"
            )
        sources: tuple[Source, ...] = find_pictures(locations, preparation)
        if self.random_scenes is not None:
            if preparation.crops > 1:
                raise InputError("--crops does not apply to random pictures; omit --crops or --random-scenes")
            number, _, size = self.random_scenes.partition(":")
            if not re.fullmatch(r"[1-9]\d{0,8}", number, re.ASCII):
                raise InputError(
                    f"--random-scenes is {self.random_scenes!r}, expected a number such as 8, or 8:256x256; correct it"
                )
            sources += random_scenes(int(number), *_size(size or "512x512", "--random-scenes"), preparation.seed)
        if not sources:
            raise InputError("there are no source pictures, expected one or more; use --sources or --random-scenes")
        return sources


@dataclass(frozen=True)
class LightOptions:
    """Illuminants of each image, and masks that distribute them."""

    light: Annotated[
        list[str] | None,
        _light_option(
            "LIGHT",
            "Illuminants for every picture: numbers of the LUT, 0,5,12-20 or all; a mixture 12:0.25+40:0.75; a colour "
            "temperature 5600K; a name such as D65 if the LUT has names; or a chromaticity r=0.3,b=0.25. May be "
            "repeated.",
        ),
    ] = None
    random: Annotated[
        int | None,
        _light_option(
            "K",
            "Make K images of each picture, under different random illuminants of the LUT, or under illuminants drawn "
            "from --distribution. \\[default: 1]",
        ),
    ] = None
    distribution: Annotated[
        str | None,
        _light_option(
            "NAME",
            "Draw chromaticities of illuminants from a distribution: uniform; gaussian:r=0.3,b=0.25,sd=0.02 (or sd_r, "
            "sd_b and corr instead of sd); or the kernel density of a file of ground truths as for --nearest.",
        ),
    ] = None
    nearest: Annotated[
        Path | None,
        _light_option(
            "GT.csv",
            "For picture or crop i, use the illuminant of the LUT with the smallest angle to ground truth i of this "
            "file (columns GT_R,GT_G,GT_B or r,g,b, or lines of three numbers). After its last line, the file is used "
            "again from the start.",
        ),
    ] = None
    match: Annotated[
        Path | None,
        _light_option(
            "GT.csv",
            "Like --nearest, with a mixture of illuminants that matches the ground truth. If a ground truth is outside "
            "the gamut of the LUT, the nearest mixture is used; a large distance is refused.",
        ),
    ] = None
    lights_per_image: Annotated[
        int | None, _light_option("K", "Use K illuminants in each image. \\[default: 1; 2 with --masks]")
    ] = None
    lights_of: Annotated[
        str | None,
        _light_option(
            "DATASET",
            "Repeat the pictures and illuminants of this data set for another camera. LUT must contain the same "
            "illuminants, and --sources the same pictures; pictures are prepared in the same way.",
        ),
    ] = None
    masks: Annotated[
        str | None,
        _light_option(
            "KIND",
            "Distribute several illuminants over the image: half-plane or soft-edge (angle, width), spots (count, "
            "radius, softness), smooth (scale, contrast), window (columns, rows, softness), with optional numbers as "
            "in spots:count=3,radius=0.1; or a folder of masks. \\[default: smooth]",
        ),
    ] = None

    def choose(self, lut: Lut, seed: int) -> LightChoice:
        """Return the illuminants that the options select."""
        from generator.lights.choices import SimultaneousLights
        from generator.masks.making import parse_masks

        per_image = self.lights_per_image or (1 if self.masks is None else 2)
        if self.lights_per_image is not None and self.lights_per_image < 1:
            raise InputError(f"--lights-per-image is {self.lights_per_image}, expected 1 or more; correct it")
        if self.masks is not None and per_image == 1:
            raise InputError(
                f"--masks {self.masks} needs several illuminants in an image, but there is 1; use --lights-per-image 2 "
                "or more"
            )
        choice = self._lights(lut, seed, per_image)
        if per_image == 1:
            return choice
        return SimultaneousLights(choice, per_image, parse_masks(self.masks or "smooth", per_image, seed))

    def _lights(self, lut: Lut, seed: int, per_image: int) -> LightChoice:
        from generator.lights import choices
        from generator.lights.distributions import ground_truths_by_line, load_ground_truths, parse_distribution
        from generator.lights.gamut import Gamut
        from generator.lights.lighting import RandomLights

        is_given_by_option = {
            "--light": bool(self.light),
            "--nearest": self.nearest is not None,
            "--match": self.match is not None,
            "--distribution": self.distribution is not None,
            "--random": self.random is not None and self.distribution is None,
        }
        given_options = [name for name, is_given in is_given_by_option.items() if is_given]
        if len(given_options) > 1:
            raise InputError(
                f"{' and '.join(given_options)} exclude each other; give only one of them (--random may be used with "
                "--distribution)"
            )
        count = per_image * (1 if self.random is None else self.random)
        if self.light:
            return choices.parse_lights(self.light, lut)
        if self.nearest is not None:
            return choices.nearest_lights(lut, load_ground_truths(self.nearest), self.nearest.name, per_image)
        if self.match is not None:
            return choices.matched_lights(Gamut.of(lut), ground_truths_by_line(self.match), self.match.name, per_image)
        if self.distribution is not None:
            return choices.DrawnLights(Gamut.of(lut), parse_distribution(self.distribution), count, seed)
        return RandomLights(count, len(lut.white), seed)


@dataclass(frozen=True)
class ImageOptions:
    """Format of the output, and the seed."""

    seed: Annotated[int, _image_option(None, "Seed of all random choices.")] = 0
    format: Annotated[
        Literal["png", "tiff", "exr", "jxl", "dng"],
        _image_option(
            None,
            "16-bit PNG (read with cv2.IMREAD_UNCHANGED or open_dataset; Pillow and imageio keep 8 bits); TIFF, "
            "uncompressed, fast and large; OpenEXR; JPEG XL, small; or Bayer DNG raw files.",
        ),
    ] = "png"
    layout: Annotated[
        Literal["folder", "c5", "webdataset", "parquet"],
        _image_option(
            None,
            "One file for each image (folder); PNG and metadata for each image, as C5 and CCMNet read them (c5); or "
            "one file for each shard: tar (WebDataset) or Parquet (Hugging Face datasets).",
        ),
    ] = "folder"
    split: Annotated[
        str | None,
        _image_option(
            "SHARES",
            "Divide by source picture into train, validation and test, such as 0.8,0.1,0.1; two shares mean train and "
            "test. A hash of each picture decides, so shares are exact only on average.",
        ),
    ] = None
    preview: Annotated[bool, _image_option(None, "Write tone-mapped previews.")] = True
    uncertainty: Annotated[
        bool,
        _image_option(
            None,
            "Add the uncertainty of each ground truth, reported by the LUT, to ground_truth.csv (degrees, k = 2).",
        ),
    ] = False
    contact_sheet: Annotated[
        Path | None,
        _image_option("PATH", "Write a page of previews to this PNG file; with --verify, of an existing data set."),
    ] = None

    def dataset_options(
        self, shard_images: int, reading: Mapping[str, Any], variation: Variation | None, crops: int
    ) -> DatasetOptions:
        """Return the options of the data set."""
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
    """Rendering of pictures to raw images."""

    rendering: Annotated[
        Literal["codes", "colorimetric"] | None,
        _image_option(
            None,
            "Render the colours of a picture as accurately as the print allows (colorimetric), or use its codes as "
            "codes of the print, as in the paper. \\[default: colorimetric; an existing data set keeps its rendering]",
        ),
    ] = None
    matrix: Annotated[
        str | None,
        _image_option(
            "NAME",
            "Matrix from linear sRGB to camera RGB, for colorimetric rendering: name of a camera, file with 3 x 3 "
            "numbers, table for a matrix fitted to the LUT, or none. \\[default: matrix of the camera of the LUT, "
            "else of the sensitivities of a computed LUT, else table]",
        ),
    ] = None
    black_point: Annotated[
        str,
        _image_option(
            "WHAT",
            "Black of the print: keep leaves it, compensate subtracts it, random or random:MAX subtracts a random "
            "share of it in each image. The ground truth does not change.",
        ),
    ] = "keep"

    def apply_to(self, options: DatasetOptions, table: Lut, existing: Rendering | None) -> DatasetOptions:
        """Return `options` with this rendering."""
        # `existing` is the rendering of a data set that is complete or in progress; None for a new data set.
        from generator.rendering.black_points import parse_black_point
        from generator.rendering.matrices import matrix_for

        rendering = self.rendering or existing or options.rendering
        if rendering == "codes" and self.matrix is not None:
            raise InputError("--matrix needs --rendering colorimetric, but the rendering is codes; omit --matrix")
        matrix = matrix_for(table, self.matrix) if rendering == "colorimetric" else None
        return replace(options, rendering=rendering, matrix=matrix, black_point=parse_black_point(self.black_point))


@dataclass(frozen=True)
class VariationOptions:
    """Random changes of each image in addition to scene and illuminant."""

    exposure: Annotated[
        str | None,
        _variation_option(
            "KIND",
            "Change the exposure: a factor such as 0.5; stops:low=-2,high=1 or normal:mean=-1,sd=0.5, drawn for each "
            "image; clip:share=0.01 saturates that share of the pixels; level:share=0.01,low=0.3,high=0.9 exposes "
            "this share to a random level relative to saturation (most=8 limits the factor). Noise follows exposure.",
        ),
    ] = None
    gradient: Annotated[
        str | None,
        _variation_option(
            "KIND",
            "Add a fall-off of brightness: smooth, soft-edge, spots or window with the numbers of --masks, and stops=1 "
            "(largest fall-off), least=0 (smallest), colour=0 (largest change of ln(R/G) and ln(B/G) at the dark end; "
            "images then get masks and ground truth maps).",
        ),
    ] = None
    iso: Annotated[
        str | None,
        _variation_option(
            "N/BASE",
            "Increase the noise from ISO speed BASE of the LUT to ISO speed N: 1600/100, or 1600/100:read=2.5 with the "
            "read noise before the amplifier in electrons. BASE may be omitted if the LUT records it.",
        ),
    ] = None

    def variation(self, lut: Lut) -> Variation | None:
        """Return the variation of the images, or None."""
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
    """Workers, shards and verification."""

    workers: Annotated[
        int | None,
        _work_option("N", "Number of threads, or of processes of the engine dask. \\[default: number of processors]"),
    ] = None
    engine: Annotated[
        str,
        _work_option(
            "NAME",
            "local, dask (a cluster on this machine), or dask://HOST:PORT of a scheduler; see docs/clusters.md.",
        ),
    ] = "local"
    shard_images: Annotated[
        int,
        _work_option(
            "N", "Images in one shard. An unfinished shard of tar or Parquet files or in a store is repeated.", min=1
        ),
    ] = 256
    shard: Annotated[
        str | None,
        _work_option(
            "I/N",
            "Make only share I of N, with I from 0 to N - 1. After all shares, run the command without this option.",
        ),
    ] = None
    dry_run: Annotated[
        bool,
        _work_option(
            None,
            "Print the number of images, the disk space, the time and the share of pixels outside of the gamut of the "
            "print, from a sample of the images; write only to the cache.",
            "--dry-run",
        ),
    ] = False
    verify: Annotated[
        str | None,
        _work_option(
            "OUT",
            "Check the hash of every file of the data set OUT and list changed files; needs no other argument.",
        ),
    ] = None

    def to_workers(self) -> Workers:
        """Return the workers; by default as many as processors."""
        from generator.dataset.making import Workers

        return Workers(self.engine, processor_count() if self.workers is None else self.workers)


def _size(text: str, name: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if not match:
        raise InputError(f"{name} is {text!r}, expected width x height such as 512x512; correct it")
    return int(match[1]), int(match[2])


@dataclass(frozen=True)
class DatasetInputs:
    """Sources and illuminants of a data set."""

    sources: tuple[Source, ...]
    choice: LightChoice
    reading: Mapping[str, Any]  # preparation of the pictures, as plain values
    lines: tuple[str, ...]  # printed for the user
    crops: int  # number for each picture


def dataset_inputs(lut: Lut, pictures: PictureOptions, light: LightOptions, seed: int) -> DatasetInputs:
    """Return the sources and illuminants that the options select."""
    from generator.lights.choices import SimultaneousLights, light_notes

    if light.lights_of is not None:
        return _inputs_of_dataset(lut, light.lights_of, pictures, light)
    preparation = pictures.preparation(seed)
    sources = pictures.find(preparation)
    choice = light.choose(lut, seed)
    if isinstance(choice, SimultaneousLights):
        choice = choice.paired([source.name for source in sources], preparation.crops)
    return DatasetInputs(sources, choice, preparation.describe(), light_notes(choice), preparation.crops)


def _inputs_of_dataset(lut: Lut, location: str, pictures: PictureOptions, light: LightOptions) -> DatasetInputs:
    from generator.dataset.reader import open_dataset
    from generator.dataset.same_lights import lights_of, scenes_of

    if replace(light, lights_of=None) != LightOptions():
        raise InputError(f"--lights-of {location} and another option both select illuminants; omit one")
    dataset = open_dataset(location)
    preparation = _preparation_as_in(pictures, dataset.description, location)
    candidates = pictures.find(preparation) if pictures.sources else ()
    sources = scenes_of(dataset, candidates)
    reading = {**preparation.describe(), "lights_of": {"pictures_seed": preparation.seed}}
    lines = tuple(
        f"the option {name.replace('_', ' ')} of {location} is not copied; set it if you need it"
        for name in ("variation", "rendering", "black_point")
        if name in dataset.description.options
    )
    return DatasetInputs(sources, lights_of(dataset, lut), reading, lines, preparation.crops)


def _preparation_as_in(pictures: PictureOptions, description: Description, location: str) -> Preparation:
    from generator.dataset.same_lights import preparation_of
    from generator.pictures.sources import UNPREPARED

    if pictures.random_scenes:
        raise InputError(f"--lights-of {location} already selects the random pictures; omit --random-scenes")
    prepared = preparation_of(description)
    requested = pictures.preparation(prepared.seed)
    if requested.describe() not in (prepared.describe(), UNPREPARED.describe()):
        raise InputError(f"--max-side, --crop and --crops differ from {location}, expected the same; omit them")
    return prepared
