"""The command `generate`: images and datasets from a table.

Parses, builds, calls, prints. Libraries that take long to load are imported when the work begins.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from foundation.console import EXIT_CODES, run
from foundation.processors import processor_count

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from generator.dataset.reader import Dataset
    from generator.pictures.picture import Preparation
    from generator.pictures.sources import Source

app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)

_SOURCES = "Source pictures"
_LIGHT = "Light"
_IMAGES = "Images"
_WORK = "Work"

_STORE_READERS = 16
"""Threads that read the files of an object store."""

_HELP = f"""Make a dataset of raw linear images with exact ground truth.

Reads the table LUT (made by build-lut) and the source pictures. Writes the dataset OUT, a folder or a URL of a store
that fsspec knows, which appears when it is complete: images/ (linear camera RGB), previews/, ground_truth.csv, gt.txt,
sources.csv, dataset.json and SHA256SUMS.

Each picture is printed, lit and photographed by the table: every pixel becomes one of the samples that the camera took
of its colour under the light. The same seed, pictures and table give the same bytes, whatever the workers. A picture
that cannot be read is passed over and told. When it was interrupted or killed, run the same command again to go on.

{EXIT_CODES}
"""


@app.command(help=_HELP)
def generate(
    lut: Annotated[Path | None, typer.Argument(metavar="LUT", help="Folder of the table.", show_default=False)] = None,
    out: Annotated[
        str | None, typer.Argument(metavar="OUT", help="Folder or URL to make; must not exist.", show_default=False)
    ] = None,
    sources: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PLACE",
            help="A picture, or a folder that is searched with those below it, or a URL of either on a store that "
            "fsspec knows; may be repeated.",
            rich_help_panel=_SOURCES,
        ),
    ] = None,
    random_scenes: Annotated[
        int,
        typer.Option(metavar="N", help="Add N pictures of uniformly random colours.", min=0, rich_help_panel=_SOURCES),
    ] = 0,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Size of the random pictures, px.", rich_help_panel=_SOURCES)
    ] = "512x512",
    max_side: Annotated[
        int | None,
        typer.Option(
            metavar="PX",
            help="Make larger pictures this small first.",
            min=1,
            show_default=False,
            rich_help_panel=_SOURCES,
        ),
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Cut pictures to this size; smaller ones are passed over.",
            show_default=False,
            rich_help_panel=_SOURCES,
        ),
    ] = None,
    cover: Annotated[
        bool,
        typer.Option(
            "--cover",
            help="Make pictures as small as still covers the crop before they are cut.",
            rich_help_panel=_SOURCES,
        ),
    ] = False,
    crop_at: Annotated[
        Literal["centre", "random"],
        typer.Option(help="Where to cut; random is chosen by the seed.", rich_help_panel=_SOURCES),
    ] = "centre",
    profiles: Annotated[
        Literal["honour", "ignore"],
        typer.Option(
            help="Convert pictures with another colour profile to sRGB, or take their codes as they stand.",
            rich_help_panel=_SOURCES,
        ),
    ] = "honour",
    illuminations: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="These lights for every picture: 0,5,12-20 or all.",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LIGHT",
            help="A light for every picture, mixed of the table's: 12, 12:0.25+40:0.75, 5600K, or a chromaticity "
            "r=.3,b=.25; may be repeated.",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    random: Annotated[
        int | None,
        typer.Option(
            metavar="K",
            help="K images of each picture, under distinct random lights of the table, or under lights drawn from "
            "--distribution. \\[default: 1]",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    distribution: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Draw chromaticities from uniform, gaussian:r=.3,b=.25,sd=.02 (or sd_r, sd_b and corr for sd), or the "
            "normal distribution fitted to a file of ground truths as of --nearest.",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    nearest: Annotated[
        Path | None,
        typer.Option(
            metavar="GT.csv",
            help="For the picture at place i the light nearest in angle to ground truth i of this file "
            "(columns GT_R,GT_G,GT_B or r,g,b, or lines of three numbers).",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    match: Annotated[
        Path | None,
        typer.Option(
            metavar="GT.csv",
            help="The same with a mixture of lights that matches the ground truth.",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    outside: Annotated[
        Literal["refuse", "nearest"],
        typer.Option(help="What to do about lights that the table cannot make.", rich_help_panel=_LIGHT),
    ] = "refuse",
    lights_per_image: Annotated[
        int | None,
        typer.Option(
            metavar="K",
            help="Let K lights fall on each image. \\[default: 1; 2 with --masks]",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    masks: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="Where each of several lights falls: half-plane or soft-edge (angle, width), spots (count, radius, "
            "softness), smooth (scale, contrast), window (columns, rows, softness), with numbers where wanted, as in "
            "spots:count=3,radius=.1; or a folder of masks. \\[default: smooth]",
            show_default=False,
            rich_help_panel=_LIGHT,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of everything random.", rich_help_panel=_IMAGES)] = 0,
    format: Annotated[
        Literal["png", "tiff", "exr", "jxl", "dng"],
        typer.Option(
            help="PNG; uncompressed TIFF, fast and large; OpenEXR; JPEG XL, small; or raw files, Bayer DNG.",
            rich_help_panel=_IMAGES,
        ),
    ] = "png",
    layout: Annotated[
        Literal["folder", "webdataset", "parquet"],
        typer.Option(
            help="Each image in a file of its own, or those of a shard in a tar file (WebDataset) or in a Parquet file "
            "(Hugging Face datasets).",
            rich_help_panel=_IMAGES,
        ),
    ] = "folder",
    split: Annotated[
        str | None,
        typer.Option(
            metavar="SHARES",
            help="Divide by source into train, validation and test, such as 0.8,0.1,0.1.",
            show_default=False,
            rich_help_panel=_IMAGES,
        ),
    ] = None,
    preview: Annotated[bool, typer.Option(help="Write tone-mapped previews.", rich_help_panel=_IMAGES)] = True,
    contact_sheet: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Write a page of previews to this PNG file; with --verify of a dataset that is there.",
            show_default=False,
            rich_help_panel=_IMAGES,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Threads, or processes of the engine dask. \\[default: one a processor]",
            show_default=False,
            rich_help_panel=_WORK,
        ),
    ] = None,
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="local, dask (a cluster on this machine), or dask://HOST:PORT of a scheduler; docs/clusters.md.",
            rich_help_panel=_WORK,
        ),
    ] = "local",
    shard_images: Annotated[
        int, typer.Option(metavar="N", help="Images of a shard: what a kill may cost.", min=1, rich_help_panel=_WORK)
    ] = 256,
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Make share I of N only, I from 0, beside other programs that make theirs; then --finish.",
            show_default=False,
            rich_help_panel=_WORK,
        ),
    ] = None,
    finish: Annotated[
        str | None,
        typer.Option(
            metavar="OUT",
            help="Make the dataset OUT of its shards when all shares are done; no other argument is needed.",
            show_default=False,
            rich_help_panel=_WORK,
        ),
    ] = None,
    verify: Annotated[
        str | None,
        typer.Option(
            metavar="OUT",
            help="Hash every file of the dataset OUT again and tell what has changed; no other argument is needed.",
            show_default=False,
            rich_help_panel=_WORK,
        ),
    ] = None,
) -> None:
    """Make a dataset."""
    _require_alone({"--verify": verify, "--finish": finish}, lut)
    if contact_sheet is not None:
        _check_sheet(contact_sheet, verify or finish or out, shard)
    if verify is not None:
        _draw_sheet(_verify(verify, workers), verify, contact_sheet)
        return
    if finish is not None:
        from generator.dataset.reader import finish_dataset

        dataset = finish_dataset(finish)
        _tell(dataset, finish)
        _draw_sheet(dataset, finish, contact_sheet)
        return

    from calibration.table.lut import open_lut
    from foundation.errors import InputError
    from generator.dataset.production.engines import check_workers
    from generator.dataset.production.plan import Options, Plan, parse_share, parse_split
    from generator.dataset.production.workplace import require_free_place
    from generator.dataset.reader import make_dataset, make_share
    from generator.lights.request import LightRequest
    from generator.pictures.picture import Preparation

    if lut is None or out is None:
        raise InputError("the table and the place of the dataset are missing; write generate LUT OUT --sources DIR")
    at_once = processor_count() if workers is None else workers
    check_workers(engine, at_once)
    require_free_place(out)
    table = open_lut(lut)
    preparation = Preparation(max_side, None if crop is None else _size(crop, "--crop"), cover, crop_at, profiles, seed)
    pictures = _choose_sources(sources or [], random_scenes, size, seed, preparation)
    request = LightRequest(
        illuminations=illuminations,
        light=tuple(light or ()),
        random=random,
        distribution=distribution,
        nearest=nearest,
        match=match,
        outside=outside,
        lights_per_image=lights_per_image,
        masks=masks,
    )
    options = Options(
        form=format,
        layout=layout,
        previews=preview,
        split=None if split is None else parse_split(split),
        shard_images=shard_images,
        sources=preparation.describe(),
    )
    plan = Plan(table, pictures, request.choose(table, seed), seed, options)
    if shard is not None:
        share = parse_share(shard)
        with _progress(sum(plan.images_of(number) for number in range(share[0], plan.shards, share[1]))) as told:
            done, shards = make_share(
                plan,
                out,
                share,
                engine=engine,
                workers=at_once,
                on_done=told.done,
                on_image=told.image,
                on_skip=told.skip,
                on_wait=told.warn,
            )
        rest = f"make a dataset of them with generate --finish {out}" if done == shards else "others are to be made yet"
        print(f"{done} of {shards} shards of {out} are done; {rest}")
        return
    with _progress(plan.total) as told:
        dataset = make_dataset(
            plan,
            out,
            engine=engine,
            workers=at_once,
            on_done=told.done,
            on_image=told.image,
            on_skip=told.skip,
            on_wait=told.warn,
        )
    _tell(dataset, out)
    _draw_sheet(dataset, out, contact_sheet)


def _require_alone(commands: dict[str, str | None], more: Path | None) -> None:
    """Refuse a second command beside one that needs its place only, and a table or place that it would not look at."""
    from foundation.errors import InputError

    given = [name for name, place in commands.items() if place is not None]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} are two commands; give one of them")
    if given and more is not None:
        raise InputError(f"{given[0]} does not expect {more}; leave it out")


@dataclass
class _Told:
    """What is shown while images are made."""

    progress: Progress
    task: TaskID

    def done(self, images: int) -> None:
        """Show what was there already."""
        if images:
            self.progress.update(self.task, total=(self.progress.tasks[0].total or 0) - images)
            self.progress.console.print(f"{images} images were there already", highlight=False)

    def image(self) -> None:
        """Show that one more image is made, at which rate since the beginning: a cluster tells of a shard at once."""
        shown = self.progress.tasks[0]
        made, took = shown.completed + 1, max(shown.elapsed or 0, 0.1)
        left = timedelta(seconds=round(max((shown.total or 0) - made, 0) * took / made))
        self.progress.update(self.task, advance=1, rate=f"{made / took:.1f}/s", left=f"{left} left")

    def skip(self, name: str, reason: str, images: int) -> None:
        """Show that a picture cannot be read."""
        self.progress.update(self.task, total=(self.progress.tasks[0].total or 0) - images)
        self.warn(f"passed over {name}: {reason}")

    def warn(self, sentence: str) -> None:
        """Show what the user should know meanwhile."""
        self.progress.console.print(sentence, style="yellow", markup=False, highlight=False)


@contextmanager
def _progress(images: int) -> Generator[_Told]:
    """Show how many images are made, how fast, and the time left, on stderr while the block runs."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (
        TextColumn("[progress.description]{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        yield _Told(progress, progress.add_task("images", total=images, rate="", left=""))


def _tell(dataset: Dataset, out: str) -> None:
    """Print what was made."""
    made = dataset.description
    lights = len({light for entry in dataset.entries for light in entry.lights})
    counts = _counted(made.images, "image"), _counted(made.sources, "picture"), _counted(lights, "light")
    print("{}: {} of {} under {}".format(out, *counts))
    if made.splits:
        print(", ".join(f"{images} for {part}" for part, images in made.splits.items()))
    if made.skipped:
        tried = made.sources + len(made.skipped)
        print(f"{len(made.skipped)} of {tried} pictures could not be read; dataset.json lists them")
    if made.replaced_pixels:
        share = 100 * made.replaced_pixels / made.pixels
        print(
            f"{made.replaced_pixels} source pixels ({share:.2g} %) are of colours that the table lists as unfit; they "
            "took the nearest fit colour"
        )


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _verify(out: str, workers: int | None) -> Dataset:
    """Print every fault of a dataset and return it; a QualityError if there is one."""
    from foundation.console import progress
    from foundation.errors import QualityError
    from generator.dataset.production.assembly import damage
    from generator.dataset.production.engines import check_workers
    from generator.dataset.reader import open_dataset
    from generator.dataset.store import is_remote

    # Whoever reads from a store waits for it most of the time.
    at_once = max(processor_count(), _STORE_READERS if is_remote(out) else 1) if workers is None else workers
    check_workers("local", at_once)
    faults = 0
    with progress("files") as told:
        for fault in damage(out, told, workers=at_once):
            print(fault)
            faults += 1
    if faults:
        raise QualityError(f"{out} is not as it was made, see above ({faults} faults); make it again, or copy it again")
    dataset = open_dataset(out)
    print(f"{out}: {_counted(dataset.description.images, 'image')}, every file as it was made")
    return dataset


def _draw_sheet(dataset: Dataset, out: str, contact_sheet: Path | None) -> None:
    """Write the contact sheet if one is wanted; a StorageError says how to have it made without the dataset."""
    if contact_sheet is None:
        return
    from foundation.errors import StorageError
    from generator.dataset.contact_sheet import save_contact_sheet

    try:
        save_contact_sheet(dataset, contact_sheet)
    except StorageError as error:
        reason = getattr(error.__cause__, "strerror", None) or error
        raise StorageError(
            f"{out} is whole, but its contact sheet {contact_sheet} cannot be written: {reason}; have it made alone by "
            f"generate --verify {out} --contact-sheet, in a place with room that may be written to"
        ) from error
    print(f"{contact_sheet}: contact sheet")


def _check_sheet(contact_sheet: Path, out: str | None, shard: str | None) -> None:
    from foundation.errors import InputError
    from generator.dataset.store import is_remote, local_path

    if shard is not None:
        raise InputError(
            "one share of a dataset has no contact sheet; ask for it with --finish OUT --contact-sheet PATH"
        )
    if out and not is_remote(out) and contact_sheet.absolute().is_relative_to(local_path(out).absolute()):
        raise InputError(
            f"the contact sheet {contact_sheet} would be no part of the dataset; name a place outside {out}"
        )
    if contact_sheet.suffix.lower() != ".png":
        raise InputError(f"the contact sheet {contact_sheet} is to be a PNG file; let its name end in .png")
    if contact_sheet.exists():
        raise InputError(f"{contact_sheet} already exists; name a new file for the contact sheet, or remove it first")


def _choose_sources(
    places: list[str], random_scenes: int, size: str, seed: int, preparation: Preparation
) -> tuple[Source, ...]:
    from foundation.errors import InputError
    from generator.pictures import sources as scene

    if not places and (preparation.crop or preparation.max_side):
        raise InputError("--crop and --max-side are for pictures, and --sources names none; random ones have --size")
    found: tuple[Source, ...] = scene.find_pictures(places, preparation)
    if random_scenes:
        found += scene.random_scenes(random_scenes, *_size(size, "--size"), seed)
    if not found:
        raise InputError("there is no source picture; name some with --sources or ask for --random-scenes")
    return found


def _size(text: str, option: str) -> tuple[int, int]:
    import re

    from foundation.errors import InputError

    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if not match:
        raise InputError(f"{option} is {text!r}, expected width x height such as 512x512")
    return int(match[1]), int(match[2])


def main() -> int:
    """Run the command; see `foundation.console.EXIT_CODES` for what is returned."""
    return run(lambda: app(prog_name="generate"))


if __name__ == "__main__":
    raise SystemExit(main())
