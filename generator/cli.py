"""The command `generate`: images and datasets from a table.

Parses, builds, calls, prints. Libraries that take long to load are imported when the work begins.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from drivers.console import EXIT_CODES, run

if TYPE_CHECKING:
    from calibration.lut import Lut
    from generator.illuminant import LightChoice
    from generator.picture import Preparation
    from generator.scene import Source

app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)

_HELP = f"""Make a dataset of raw linear images with exact ground truth.

Reads the table LUT (made by build-lut) and the source pictures. Writes the folder OUT, which appears when it is
complete: images/ (16-bit linear camera RGB), previews/, ground_truth.csv, gt.txt, dataset.json and SHA256SUMS.

Each picture is printed, lit and photographed by the table: every pixel becomes one of the samples that the camera took
of its colour under the light. The same seed, pictures and table give the same bytes, whatever the workers. A picture
that cannot be read is passed over and told.

{EXIT_CODES}
"""


@app.command(help=_HELP)
def generate(
    lut: Annotated[Path, typer.Argument(metavar="LUT", help="Folder of the table.", show_default=False)],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to make; must not exist.", show_default=False)],
    sources: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PLACE",
            help="A picture, or a folder that is searched with those below it, or a URL of either on a store that "
            "fsspec knows; may be repeated.",
        ),
    ] = None,
    random_scenes: Annotated[
        int, typer.Option(metavar="N", help="Add N pictures of uniformly random colours.", min=0)
    ] = 0,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the random pictures, px.")] = "512x512",
    illuminations: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="These lights for every picture: 0,5,12-20 or all.", show_default=False),
    ] = None,
    random: Annotated[
        int | None,
        typer.Option(metavar="K", help="K distinct random lights for each picture. [default: 1]", show_default=False),
    ] = None,
    nearest: Annotated[
        Path | None,
        typer.Option(
            metavar="GT.csv",
            help="For the picture at place i the light nearest in angle to ground truth i of this file "
            "(columns GT_R,GT_G,GT_B or r,g,b, or lines of three numbers).",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    format: Annotated[Literal["png", "tiff"], typer.Option(help="PNG, or uncompressed TIFF: fast and large.")] = "png",
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Threads. [default: one a processor]", show_default=False)
    ] = None,
    max_side: Annotated[
        int | None, typer.Option(metavar="PX", help="Make larger pictures this small first.", min=1, show_default=False)
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Cut pictures to this size; smaller ones are passed over.", show_default=False
        ),
    ] = None,
    cover: Annotated[
        bool, typer.Option("--cover", help="Make pictures as small as still covers the crop before they are cut.")
    ] = False,
    crop_at: Annotated[
        Literal["centre", "random"], typer.Option(help="Where to cut; random is chosen by the seed.")
    ] = ("centre"),
    profiles: Annotated[
        Literal["honour", "ignore"],
        typer.Option(help="Convert pictures with another colour profile to sRGB, or take their codes as they stand."),
    ] = "honour",
    preview: Annotated[bool, typer.Option(help="Write tone-mapped previews.")] = True,
    contact_sheet: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Write a page of previews to this PNG file.", show_default=False),
    ] = None,
) -> None:
    """Make a dataset."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from calibration.lut import open_lut
    from drivers.errors import InputError
    from generator.dataset import generate_dataset
    from generator.engines import default_workers
    from generator.picture import Preparation
    from generator.workplace import require_free_place

    require_free_place(out)
    if contact_sheet is not None and contact_sheet.suffix.lower() != ".png":
        raise InputError(f"the contact sheet {contact_sheet} is to be a PNG file; let its name end in .png")
    if contact_sheet is not None and contact_sheet.exists():
        raise InputError(f"{contact_sheet} already exists; name a new file for the contact sheet, or remove it first")
    table = open_lut(lut)
    preparation = Preparation(max_side, None if crop is None else _size(crop, "--crop"), cover, crop_at, profiles, seed)
    pictures = _choose_sources(sources or [], random_scenes, size, seed, preparation)
    choice = _choose_lights(table, illuminations, random, nearest, seed)
    console = Console(stderr=True)
    with Progress(
        TextColumn("[progress.description]{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        console=console,
    ) as progress:
        task = progress.add_task("images", total=len(pictures) * choice.lights_each, rate="")

        def on_image() -> None:
            speed = progress.tasks[0].speed
            progress.update(task, advance=1, rate=f"{speed:.1f}/s" if speed else "")

        def on_skip(name: str, reason: str, images: int) -> None:
            progress.update(task, total=(progress.tasks[0].total or 0) - images)
            progress.console.print(f"passed over {name}: {reason}", style="yellow", markup=False, highlight=False)

        dataset = generate_dataset(
            table,
            out,
            pictures,
            choice,
            seed=seed,
            form=format,
            reading=preparation.describe(),
            workers=default_workers() if workers is None else workers,
            previews=preview,
            on_image=on_image,
            on_skip=on_skip,
        )
    made = dataset.description
    print(f"{out}: {made.images} images of {made.sources} pictures under {len(made.lights)} lights")
    if made.skipped:
        print(f"{len(made.skipped)} of {len(pictures)} pictures could not be read; dataset.json lists them")
    if made.replaced_pixels:
        share = 100 * made.replaced_pixels / made.pixels
        print(
            f"{made.replaced_pixels} source pixels ({share:.2g} %) are of the {len(table.provenance.unfit)} colours "
            "that the table lists as unfit; they took the nearest fit colour"
        )
    if contact_sheet is not None:
        from generator.contact import save_contact_sheet

        save_contact_sheet(dataset, contact_sheet)
        print(f"{contact_sheet}: contact sheet")


def _choose_sources(
    places: list[str], random_scenes: int, size: str, seed: int, preparation: Preparation
) -> tuple[Source, ...]:
    from drivers.errors import InputError
    from generator import scene

    found: tuple[Source, ...] = scene.find_pictures(places, preparation)
    if random_scenes:
        found += scene.random_scenes(random_scenes, *_size(size, "--size"), seed)
    if not found:
        raise InputError("there is no source picture; name some with --sources or ask for --random-scenes")
    return found


def _size(text: str, option: str) -> tuple[int, int]:
    import re

    from drivers.errors import InputError

    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if not match:
        raise InputError(f"{option} is {text!r}, expected width x height such as 512x512")
    return int(match[1]), int(match[2])


def _choose_lights(
    table: Lut, illuminations: str | None, random: int | None, nearest: Path | None, seed: int
) -> LightChoice:
    from drivers.errors import InputError
    from generator import illuminant

    given = [
        name
        for name, value in (("--illuminations", illuminations), ("--random", random), ("--nearest", nearest))
        if value is not None
    ]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} were both given; choose lights in one way")
    total = len(table.illuminations)
    if illuminations is not None:
        return illuminant.parse_lights(illuminations, total)
    if nearest is not None:
        return illuminant.nearest_lights(table, illuminant.load_ground_truths(nearest), nearest.name)
    return illuminant.RandomLights(1 if random is None else random, total, seed)


def main() -> int:
    """Run the command; see `drivers.console.EXIT_CODES` for what is returned."""
    return run(lambda: app(prog_name="generate"))


if __name__ == "__main__":
    raise SystemExit(main())
