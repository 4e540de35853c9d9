"""The command `generate`: images and datasets from a table.

Parses, builds, calls, prints. Libraries that take long to load are imported when the work begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from calibration.table.demo_table import DEMO, table_folder
from foundation.compiled import processor_count
from foundation.console import (
    EXIT_CODES,
    JsonOutput,
    MainCommand,
    new_app,
    orderly_end,
    progress,
    resume_gc,
    run,
    with_json,
    with_option_groups,
)
from foundation.errors import InputError, QualityError, StorageError, counted
from foundation.secret_texts import masked, printable
from generator.options import (
    ImageOptions,
    LightOptions,
    PictureOptions,
    Places,
    RenderingOptions,
    VariationOptions,
    WorkOptions,
    choose,
)
from generator.progress import shown_progress

if TYPE_CHECKING:
    from generator.dataset.making import Workers
    from generator.dataset.plan import Plan
    from generator.dataset.reader import Dataset
    from generator.dataset.records import Description
    from generator.rendering.matrices import ColourMatrix


app = new_app()
_explore_app = new_app()

# Threads that read the files of an object store: a reader waits for the store most of the time.
_STORE_READERS: Final = 16

_HELP = f"""Make a dataset of raw linear images with exact ground truth.

Reads the table LUT (made by build-lut) and the source pictures. Writes the dataset OUT, a folder or a URL of a store
that fsspec knows, which appears when it is complete: images/ (linear camera RGB; other files by --layout),
previews/, ground_truth.csv, gt.txt, sources.csv, dataset.json and SHA256SUMS.

Each picture is printed, lit and photographed by the table: a pixel becomes what the camera sees of its colour under the
light, interpolated between cells, plus the deviation of one of the samples that it took; with --rendering codes, one of
these samples itself. The same seed, pictures and table give the same bytes, whatever the workers. A picture that cannot
be read is left out, and named. When it was interrupted or killed, run the same command again to go on.

Examples: a first dataset, of a table that is computed; training crops under lights of any chromaticity; test images of
two lights each, by the paper's rendering.

generate demo: first/ --sources photographs/

generate lut/ train/ --sources photographs/ --crop 256x256 --crops 4 --distribution uniform

generate lut/ test/ --sources photographs/ --lights-per-image 2 --masks smooth --rendering codes

{EXIT_CODES}
"""


class _Generate(MainCommand):
    subcommands = _explore_app


@app.command(help=_HELP, cls=_Generate)
@with_json("generate")
@with_option_groups
def generate(
    output: JsonOutput,
    places: Places,
    pictures: PictureOptions,
    light: LightOptions,
    rendering: RenderingOptions,
    variation: VariationOptions,
    images: ImageOptions,
    work: WorkOptions,
) -> None:
    """Make a dataset, or one share of it; or verify one that is there."""
    if work.verify is not None and places.lut is not None:
        raise InputError(f"--verify does not expect {places.lut}; leave it out")
    sheet = images.contact_sheet
    if sheet is not None:
        _check_sheet(sheet, work.verify or places.out, work.shard, again=work.verify is None)
    if work.verify is not None:
        resume_gc()
        _draw_sheet(_verify(work.verify, work.workers, output), work.verify, sheet)
    else:
        if places.lut is None or places.out is None:
            raise InputError(_missing_place(places.lut))
        if _is_table(places.out) and not _is_table(str(places.lut)):
            raise InputError(
                f"{places.out} is a table and {places.lut} none: the table comes first, then the place of the "
                f"dataset: generate {places.out} {places.lut}"
            )
        from generator.dataset.making import made_before

        resume_gc()
        workers = work.makers()
        plan = _plan(places.lut, places.out, pictures, light, rendering, variation, images, work)
        there = made_before(plan, places.out)
        if there is not None:
            _print_summary(there, places.out, output, was_there=True)
            _draw_sheet(there, places.out, sheet)
        elif work.shard is not None:
            _make_share(plan, places.out, work.shard, workers, output)
        else:
            dataset = _make_whole(plan, places.out, workers, output)
            _draw_sheet(dataset, places.out, sheet)


@_explore_app.command(epilog=EXIT_CODES)
def explore(
    lut: Annotated[Path, typer.Argument(metavar="LUT", help="Folder of the table; demo: for a small one.")],
    sources: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PLACE",
            help="A picture, or a folder that is searched, or a URL of either; may be repeated. Three computed "
            "pictures if there is none.",
            show_default=False,
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 8708,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on; 0.0.0.0 lets other machines in the house look, a phone for one."),
    ] = "127.0.0.1",
) -> None:
    """Show a table in the browser, until interrupted: its lights, and pictures under any of them.

    Reads the table LUT and pictures; writes nothing but what can be computed again, to the cache. The page has the
    table's lights in the plane of chromaticities, with the black bodies and all that they can make together: pick a
    light, drag one, or mix two. A picture is shown as the camera would take its print, by codes and by colour, with
    ground truth, histogram, single pixels and their noise, and with the command that makes a dataset of it. A picture
    dropped onto the page stays in memory. With --host the address holds a token, new at each start.
    """
    from calibration.table.lut import open_lut
    from generator.explore.explorer import MAX_SIDE, Explorer, ExploreServer, sample_folder
    from generator.pictures.sources import Preparation, find_pictures

    resume_gc()
    table = open_lut(table_folder(lut))
    found = find_pictures(sources or [str(sample_folder())], Preparation(max_side=MAX_SIDE))
    with ExploreServer(Explorer(str(lut), table, found), host, port) as server:
        server.serve(str(lut), "can look at the table and the pictures, and send pictures of their own")


def _is_table(place: str) -> bool:
    return place == DEMO or (Path(place) / "lut.json").is_file()


def _missing_place(given: Path | None) -> str:
    """Return which of table and dataset is missing where one place at most is given, and how both are written."""
    if given is None:
        what, lut, out = "the table and the place of the dataset are", "LUT", "OUT"
    elif _is_table(str(given)):
        what, lut, out = f"{given} is the table, and the place of the dataset is", str(given), "OUT"
    else:
        what, lut, out = f"{given} is no table, and it, or the place of the dataset, is", "LUT", str(given)
    help_for = "" if lut != "LUT" else ", with demo: for LUT where you have no table yet"
    return f"{what} missing; write generate {lut} {out} --sources DIR{help_for}"


def _plan(
    lut: Path,
    out: str,
    pictures: PictureOptions,
    light: LightOptions,
    rendering: RenderingOptions,
    variation: VariationOptions,
    images: ImageOptions,
    work: WorkOptions,
) -> Plan:
    """Return the plan of a dataset whose place is free, or holds a dataset, which may be the one planned."""
    from calibration.table.lut import open_lut
    from generator.dataset.making import begun_rendering, holds_dataset, require_free_place
    from generator.dataset.plan import Plan

    if not holds_dataset(out):
        require_free_place(out)
    table = open_lut(table_folder(lut))
    begun = None if rendering.rendering else begun_rendering(out)
    chosen = choose(table, pictures, light, images.seed)
    for line in chosen.lines:
        print(line)
    options = images.dataset_options(work.shard_images, chosen.reading, variation.variation(table), chosen.crops)
    plan = Plan(table, chosen.sources, chosen.choice, images.seed, rendering.of(options, table, begun))
    if plan.options.matrix is not None:
        print(matrix_sentence(plan.options.matrix, table.provenance.camera, chosen=rendering.matrix is not None))
    return plan


def _make_whole(plan: Plan, out: str, workers: Workers, output: JsonOutput) -> Dataset:
    from generator.dataset.making import make_dataset

    with orderly_end(), shown_progress(plan.total) as callbacks:
        dataset = make_dataset(plan, out, workers, callbacks)
    _print_summary(dataset, out, output)
    return dataset


def _make_share(plan: Plan, out: str, shard: str, workers: Workers, output: JsonOutput) -> None:
    from generator.dataset.making import make_share, parse_share

    share = parse_share(shard)
    shards = range(share[0], plan.shards, share[1])
    with orderly_end(), shown_progress(sum(map(plan.images_of, shards))) as callbacks:
        done, every = make_share(plan, out, share, workers, callbacks)
    output.add(dataset=masked(out), shard=shard, shards_done=done, shards=every)
    finish = "run the same command without --shard to make a dataset of them"
    left = finish if done == every else "others are still to be made"
    print(masked(f"{done} of {every} shards of {out} are done; {left}"))


def _print_summary(dataset: Dataset, out: str, output: JsonOutput, was_there: bool = False) -> None:
    made = dataset.description
    lights = len(dataset.light_labels)
    # A picture that was drawn several times is a source each time; one that was made and not read has no hash.
    different = len({source.sha256 or source.name for source in dataset.sources})
    noted = [source for source in dataset.sources if source.note]
    pictures = counted(made.sources, "picture")
    if different < made.sources:
        pictures += f", {different} of them different,"
    choice = made.options["lights"]
    if choice["choice"] == "together":
        choice = choice["lights"]
    output.add(
        dataset=masked(out),
        made=not was_there,
        images=made.images,
        planned=made.planned,
        pictures=made.sources,
        different_pictures=different,
        lights=lights,
        outside=choice.get("outside"),
        splits=made.splits,
        skipped=[skipped.name for skipped in made.skipped],
        noted=len(noted),
        pixels=made.pixels,
        replaced_pixels=made.replaced_pixels,
        rendering=None if made.rendering is None else made.rendering.model_dump(mode="json"),
    )
    there = ", complete already; nothing was made" if was_there else ""
    print(f"{masked(out)}: {counted(made.images, 'image')} of {pictures} under {counted(lights, 'light')}{there}")
    if made.splits:
        parts = ", ".join(f"{images} for {part}" for part, images in made.splits.items())
        print(parts if made.splits.get("validation") else f"{parts}: two shares are those of train and test")
    if made.skipped:
        tried = made.sources + len(made.skipped)
        was = "was" if len(made.skipped) == 1 else "were"
        print(f"{len(made.skipped)} of {tried} pictures {was} left out; dataset.json lists them")
    if noted:
        example = printable(f"{noted[0].name}: {noted[0].note}")
        has = "has a note" if len(noted) == 1 else "have notes"
        print(f"{counted(len(noted), 'picture')} {has} in sources.csv, such as {example}")
    if made.replaced_pixels:
        share = 100 * made.replaced_pixels / made.pixels
        print(
            f"{made.replaced_pixels} source pixels ({share:.2g} %) are of colours that the table lists as unfit; they "
            "took the nearest fit colour"
        )
    if made.rendering is not None and made.rendering.outside:
        print(
            f"{100 * made.rendering.outside:.2g} % of the pixels are of colours that the print cannot show; colours "
            f"are {made.rendering.distance or 0:.2g} degrees off in the mean. Ground truths are the lights', and as "
            f"exact as ever{_wider_print(made)}"
        )


def _wider_print(made: Description) -> str:
    computed = made.table.computed or {}
    unmanaged = computed.get("room", {}).get("profile") == "unmanaged"
    return (
        '; sim table with profile = "managed" in its settings makes a table that shows more colours'
        if unmanaged
        else ""
    )


def _verify(out: str, workers: int | None, output: JsonOutput) -> Dataset:
    """Print every fault of a dataset and return it; a QualityError if there is one."""
    from generator.dataset.making import Workers
    from generator.dataset.reader import file_faults, open_dataset
    from generator.stores import is_remote

    by_default = max(processor_count(), _STORE_READERS if is_remote(out) else 1)
    at_once = Workers(count=by_default if workers is None else workers).count
    faults: list[str] = []
    with progress("files") as shown:
        for fault in file_faults(out, shown, workers=at_once):
            print(printable(fault))
            faults.append(printable(fault))
    output.add(dataset=masked(out), faults=faults)
    if faults:
        raise QualityError(
            f"{out} is not as it was made: {counted(len(faults), 'fault')}, listed above; make it again, or copy it "
            "again"
        )
    dataset = open_dataset(out)
    output.add(images=dataset.description.images)
    print(f"{masked(out)}: {counted(dataset.description.images, 'image')}, every file as it was made")
    return dataset


def _check_sheet(contact_sheet: Path, out: str | None, shard: str | None, again: bool) -> None:
    """Refuse a contact sheet that could not be written when the dataset is made.

    One that is there is refused unless a dataset is, too, where the command may have made both before.
    """
    from generator.dataset.making import holds_dataset
    from generator.stores import is_remote, local_path

    if shard is not None:
        raise InputError(
            "one share of a dataset has no contact sheet; ask for it when all shares are done, without --shard"
        )
    if out and not is_remote(out) and contact_sheet.absolute().is_relative_to(local_path(out).absolute()):
        raise InputError(
            f"the contact sheet {contact_sheet} would be no part of the dataset; name a place outside {out}"
        )
    if contact_sheet.suffix.lower() != ".png":
        raise InputError(f"the contact sheet {contact_sheet} is to be a PNG file; let its name end in .png")
    if contact_sheet.exists() and not (again and out and holds_dataset(out)):
        raise InputError(f"{contact_sheet} already exists; name a new file for the contact sheet, or remove it first")


def _draw_sheet(dataset: Dataset, out: str, contact_sheet: Path | None) -> None:
    """Write the contact sheet if one is wanted; a StorageError says how to make it from the finished dataset."""
    if contact_sheet is None:
        return
    if contact_sheet.exists():
        print(f"{contact_sheet}: a contact sheet is there already, and stays as it is")
        return
    from generator.dataset.contact_sheet import save_contact_sheet

    try:
        save_contact_sheet(dataset, contact_sheet)
    except StorageError as error:
        reason = getattr(error.__cause__, "strerror", None) or error
        raise StorageError(
            f"{out} is complete, but its contact sheet {contact_sheet} cannot be written: {reason}; free space or "
            f"choose another place, then make the sheet with generate --verify {out} --contact-sheet PATH"
        ) from error
    print(f"{contact_sheet}: contact sheet")


def matrix_sentence(matrix: ColourMatrix, camera: str, *, chosen: bool) -> str:
    """Return which colour matrix is taken, where it comes from, and what to mind if the table gave it."""
    from generator.rendering.matrices import TABLE

    sentence = f"colour matrix: {matrix.name} ({matrix.source})"
    if matrix.name != TABLE:
        return sentence
    why = "" if chosen else f"that of {camera} is not known, so this one was fitted; "
    return (
        f"{sentence}; {why}if the print's colours were not managed, its faults are in the matrix as well: --matrix "
        "NAME or FILE takes that of a camera"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with `argv`, or the program's own arguments if None, and return its exit code.

    `foundation.console.EXIT_CODES` lists the codes.
    """
    return run(lambda: app(None if argv is None else list(argv), prog_name="generate"), pause_gc=True)


if __name__ == "__main__":
    raise SystemExit(main())
