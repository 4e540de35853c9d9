"""The command `generate`: images and data sets from a look-up table (LUT).

It parses options, calls the library and prints. Slow libraries are imported only when the work starts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import timedelta
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
from foundation.folders import bytes_text, free_bytes_at
from foundation.remote import is_remote
from foundation.secret_texts import masked, printable
from generator.options import (
    ImageOptions,
    LightOptions,
    PathArguments,
    PictureOptions,
    RenderingOptions,
    VariationOptions,
    WorkOptions,
    dataset_inputs,
)
from generator.progress import show_progress

if TYPE_CHECKING:
    from generator.dataset.making import Workers
    from generator.dataset.plan import Plan
    from generator.dataset.reader import Dataset
    from generator.dataset.records import RenderingSummary
    from generator.rendering.matrices import ColourMatrix


app = new_app()
_explore_app = new_app()

# Number of threads that read files from an object store. It is large, because a thread mostly waits for the store.
_STORE_READERS: Final = 16

_HELP = f"""Make a data set of raw linear images with exact ground truth.

Reads the look-up table LUT (made by build-lut) and the source pictures. Writes the data set OUT, a folder or the URL
of a store supported by fsspec. OUT appears when it is complete: images/ (linear camera RGB; other files with
--layout), previews/, ground_truth.csv, gt.txt, sources.csv, dataset.json and SHA256SUMS.

Each image shows a print of the picture under an illuminant, as the camera would record it. By default, a pixel is the
mean response to the colour of the picture, interpolated between patches of the chart, plus noise. With --rendering
codes, a pixel is one sample of the patch with the code of the picture. Equal seed, pictures and LUT give equal bytes
with any number of workers. A picture that cannot be read is skipped and listed. To resume an interrupted run, run the
same command again.

The examples make a first data set from a computed LUT; training crops under illuminants of any chromaticity; and test
images with two illuminants each, rendered as in the paper.

generate demo: first/ --sources photographs/

generate lut/ train/ --sources photographs/ --crop 256x256 --crops 4 --distribution uniform

generate lut/ test/ --sources photographs/ --lights-per-image 2 --masks smooth --rendering codes

{EXIT_CODES}
"""


class _Generate(MainCommand):
    subcommands = _explore_app  # the command `generate explore`


@app.command(help=_HELP, cls=_Generate)
@with_json("generate")
@with_option_groups
def generate(
    output: JsonOutput,
    paths: PathArguments,
    pictures: PictureOptions,
    light: LightOptions,
    rendering: RenderingOptions,
    variation: VariationOptions,
    images: ImageOptions,
    work: WorkOptions,
) -> None:
    """Make a data set or one share of it, or verify an existing data set."""
    if work.verify is not None and work.dry_run:
        raise InputError("--verify and --dry-run exclude each other; omit one")
    if work.verify is not None and paths.lut is not None:
        raise InputError(f"--verify takes no LUT, but {paths.lut} is given; omit it")
    sheet = images.contact_sheet
    if sheet is not None:
        _check_sheet(sheet, work.verify or paths.out, work.shard, is_rerun=work.verify is None)
    if work.verify is not None:
        resume_gc()
        _draw_sheet(_verify(work.verify, work.workers, output), work.verify, sheet)
    else:
        if paths.lut is None or paths.out is None:
            raise InputError(_missing_arguments_message(paths.lut))
        if _is_table(paths.out) and not _is_table(str(paths.lut)):
            raise InputError(
                f"the second argument {paths.out} is a LUT and the first argument {paths.lut} is not; give the LUT "
                f"first: generate {paths.out} {paths.lut}"
            )
        from generator.dataset.making import completed_dataset

        resume_gc()
        workers = work.to_workers()
        plan = _plan(paths.lut, paths.out, pictures, light, rendering, variation, images, work)
        existing = completed_dataset(plan, paths.out)
        if existing is not None:
            _print_summary(existing, paths.out, output, is_existing=True)
            _draw_sheet(existing, paths.out, sheet)
        elif work.dry_run:
            _print_forecast(plan, paths.out, work.shard, workers, output)
        elif work.shard is not None:
            _make_share(plan, paths.out, work.shard, workers, output)
        else:
            dataset = _make_whole(plan, paths.out, workers, output)
            _draw_sheet(dataset, paths.out, sheet)


@_explore_app.command(epilog=EXIT_CODES)
def explore(
    lut: Annotated[Path, typer.Argument(metavar="LUT", help="Folder of the LUT, or demo: for a small example.")],
    sources: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PLACE",
            help="A picture, a folder with pictures, or a URL of either; may be repeated. Without it, three computed "
            "pictures are used.",
            show_default=False,
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 selects a free one.")] = 8708,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on; 0.0.0.0 lets other devices in the network connect, such as a phone."),
    ] = "127.0.0.1",
) -> None:
    """Show a LUT and pictures in the browser until interrupted.

    Reads the look-up table LUT and pictures; writes only to the cache. The page shows the illuminants in the
    chromaticity plane with the black-body curve and the gamut of all mixtures: select an illuminant, drag it, or mix
    two. It shows the image of each picture for both renderings, with ground truth, histogram and the noise of single
    pixels. It also shows the command that makes a data set from the picture. A picture dropped onto the page is kept
    in memory only. With --host the address of the page contains a secret token, which is new at each start.
    """
    from calibration.table.lut import open_lut
    from generator.explore.explorer import MAX_SIDE, Explorer, ExploreServer, sample_folder
    from generator.pictures.sources import Preparation, find_pictures

    resume_gc()
    table = open_lut(table_folder(lut))
    picture_files = find_pictures(sources or [str(sample_folder())], Preparation(max_side=MAX_SIDE))
    with ExploreServer(Explorer(str(lut), table, picture_files), host, port) as server:
        server.serve(str(lut), "can view the LUT and the pictures, and upload pictures")


def _is_table(location: str) -> bool:
    return location == DEMO or (Path(location) / "lut.json").is_file()


def _missing_arguments_message(path: Path | None) -> str:
    if path is None:
        subject, lut, out = "the arguments LUT and OUT are missing", "LUT", "OUT"
    elif _is_table(str(path)):
        subject, lut, out = f"{path} is the LUT; the argument OUT is missing", str(path), "OUT"
    else:
        subject, lut, out = f"{path} is not a LUT; expected the arguments LUT and OUT", "LUT", str(path)
    demo_hint = "" if lut != "LUT" else ", with demo: instead of LUT if you have no LUT yet"
    return f"{subject}; run generate {lut} {out} --sources DIR{demo_hint}"


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
    from calibration.table.lut import open_lut
    from generator.dataset.making import existing_rendering, holds_dataset, require_free_place
    from generator.dataset.plan import Plan

    if not holds_dataset(out):
        require_free_place(out)
    table = open_lut(table_folder(lut))
    current = None if rendering.rendering else existing_rendering(out)
    inputs = dataset_inputs(table, pictures, light, images.seed)
    for line in inputs.lines:
        print(line)
    options = images.dataset_options(work.shard_images, inputs.reading, variation.variation(table), inputs.crops)
    plan = Plan(table, inputs.sources, inputs.choice, images.seed, rendering.apply_to(options, table, current))
    if plan.options.matrix is not None:
        print(matrix_sentence(plan.options.matrix, table.provenance.camera, is_chosen=rendering.matrix is not None))
    return plan


def _print_forecast(plan: Plan, out: str, shard: str | None, workers: Workers, output: JsonOutput) -> None:
    from generator.dataset.forecast import forecast
    from generator.dataset.making import parse_share
    from generator.stores import local_path

    index, count = (0, 1) if shard is None else parse_share(shard)
    free_bytes = None if is_remote(out) else free_bytes_at(local_path(out))
    made = forecast(plan, sum(map(plan.images_of, range(index, plan.shards, count))), workers.count)
    pictures = len(plan.sources)
    output.add(
        dataset=masked(out),
        images=made.images,
        pictures=pictures,
        needed_bytes=made.needed_bytes,
        free_bytes=free_bytes,
        time_s=round(made.time_s, 3),
        workers=workers.count,
        outside_gamut=made.rendering.outside,
        colour_error_deg=made.rendering.distance,
        sampled=made.sampled,
        skipped=[printable(reason) for reason in made.skipped],
    )
    free_text = "" if free_bytes is None else f", {bytes_text(free_bytes)} free"
    print(f"{masked(out)}: {counted(made.images, 'image')} of {counted(pictures, 'picture')}")
    print(f"{bytes_text(made.needed_bytes, up=True)} needed{free_text}")
    if free_bytes is not None and made.needed_bytes > free_bytes:
        print("the disk is too small; free space, or choose another location")
    place = ", without the transfer to the store" if free_bytes is None else ""
    print(f"about {timedelta(seconds=math.ceil(made.time_s))} with {counted(workers.count, 'thread')} here{place}")
    _print_gamut(made.rendering)
    for reason in made.skipped:
        print(printable(f"will be skipped: {reason}"))
    print(f"estimated from {made.sampled} of {counted(pictures, 'picture')}; nothing was written")


def _print_gamut(rendering: RenderingSummary | None) -> None:
    if rendering is not None and rendering.outside:
        print(
            f"{100 * rendering.outside:.2g} % of the pixels have colours that the print cannot show; the "
            f"mean colour error is {rendering.distance or 0:.2g} degrees. The ground truth is not affected"
        )


def _make_whole(plan: Plan, out: str, workers: Workers, output: JsonOutput) -> Dataset:
    from generator.dataset.making import make_dataset

    with orderly_end(), show_progress(plan.total) as callbacks:
        dataset = make_dataset(plan, out, workers, callbacks)
    _print_summary(dataset, out, output)
    return dataset


def _make_share(plan: Plan, out: str, shard: str, workers: Workers, output: JsonOutput) -> None:
    from generator.dataset.making import make_share, parse_share

    share = parse_share(shard)
    shards = range(share[0], plan.shards, share[1])
    with orderly_end(), show_progress(sum(map(plan.images_of, shards))) as callbacks:
        done_count, shard_count = make_share(plan, out, share, workers, callbacks)
    output.add(dataset=masked(out), shard=shard, shards_done=done_count, shards=shard_count)
    finish = "run the same command without --shard to complete the data set"
    next_step = finish if done_count == shard_count else "run the same command with the other shares of --shard first"
    print(masked(f"{done_count} of {shard_count} shards of {out} are done; {next_step}"))


def _print_summary(dataset: Dataset, out: str, output: JsonOutput, is_existing: bool = False) -> None:
    record = dataset.description
    lights = len(dataset.light_labels)
    # A picture may be several sources. A computed picture has no hash, so its name is used.
    different = len({source.sha256 or source.name for source in dataset.sources})
    noted = [source for source in dataset.sources if source.note]
    pictures = counted(record.sources, "picture")
    if different < record.sources:
        pictures += f" ({different} different)"
    choice = record.options["lights"]
    if choice["choice"] == "together":
        choice = choice["lights"]
    output.add(
        dataset=masked(out),
        made=not is_existing,
        images=record.images,
        planned=record.planned,
        pictures=record.sources,
        different_pictures=different,
        lights=lights,
        outside=choice.get("outside"),
        splits=record.splits,
        skipped=[skipped.name for skipped in record.skipped],
        noted=len(noted),
        pixels=record.pixels,
        replaced_pixels=record.replaced_pixels,
        rendering=None if record.rendering is None else record.rendering.model_dump(mode="json"),
    )
    note = "; it was already complete" if is_existing else ""
    print(f"{masked(out)}: {counted(record.images, 'image')} of {pictures} under {counted(lights, 'illuminant')}{note}")
    if record.splits:
        split_text = ", ".join(f"{images} for {split}" for split, images in record.splits.items())
        print(split_text if record.splits.get("validation") else f"{split_text} (no images for validation)")
    if record.skipped:
        tried = record.sources + len(record.skipped)
        was = "was" if len(record.skipped) == 1 else "were"
        print(f"{len(record.skipped)} of {tried} pictures {was} skipped; dataset.json lists them")
    if noted:
        example = printable(f"{noted[0].name}: {noted[0].note}")
        has = "has a note" if len(noted) == 1 else "have notes"
        print(f"{counted(len(noted), 'picture')} {has} in sources.csv, for example {example}")
    if record.replaced_pixels:
        share = 100 * record.replaced_pixels / record.pixels
        print(
            f"{record.replaced_pixels} source pixels ({share:.2g} %) have colours that the LUT lists as unfit; "
            "they were replaced by the nearest usable colour"
        )
    _print_gamut(record.rendering)


def _verify(out: str, workers: int | None, output: JsonOutput) -> Dataset:
    from generator.dataset.making import Workers
    from generator.dataset.reader import file_faults, open_dataset

    default_count = max(processor_count(), _STORE_READERS if is_remote(out) else 1)
    reader_count = Workers(count=default_count if workers is None else workers).count
    faults: list[str] = []
    with progress("files") as update_progress:
        for fault in file_faults(out, update_progress, workers=reader_count):
            print(printable(fault))
            faults.append(printable(fault))
    output.add(dataset=masked(out), faults=faults)
    if faults:
        raise QualityError(
            f"{out} has {counted(len(faults), 'fault')}, listed above, expected unchanged files; make the data set "
            "again, or copy it again"
        )
    dataset = open_dataset(out)
    output.add(images=dataset.description.images)
    print(f"{masked(out)}: {counted(dataset.description.images, 'image')}, all files are unchanged")
    return dataset


def _check_sheet(contact_sheet: Path, out: str | None, shard: str | None, is_rerun: bool) -> None:
    from generator.dataset.making import holds_dataset
    from generator.stores import local_path

    if shard is not None:
        raise InputError(
            f"--contact-sheet needs the complete data set, but --shard {shard} makes one share; use it in the last "
            "run, without --shard"
        )
    if out and not is_remote(out) and contact_sheet.absolute().is_relative_to(local_path(out).absolute()):
        raise InputError(f"the contact sheet {contact_sheet} is inside the data set; choose a path outside {out}")
    if contact_sheet.suffix.lower() != ".png":
        raise InputError(f"the contact sheet {contact_sheet} must be a PNG file; choose a name that ends in .png")
    # If an earlier run of the same command completed the data set, it may also have made the sheet.
    if contact_sheet.exists() and not (is_rerun and out and holds_dataset(out)):
        raise InputError(f"the contact sheet {contact_sheet} already exists; choose another name, or remove it first")


def _draw_sheet(dataset: Dataset, out: str, contact_sheet: Path | None) -> None:
    if contact_sheet is None:
        return
    if contact_sheet.exists():
        print(f"{contact_sheet}: the contact sheet already exists and is not changed")
        return
    from generator.dataset.contact_sheet import save_contact_sheet

    try:
        save_contact_sheet(dataset, contact_sheet)
    except StorageError as error:
        reason = getattr(error.__cause__, "strerror", None) or error
        raise StorageError(
            f"{out} is complete, but its contact sheet {contact_sheet} cannot be written: {reason}; free space or "
            f"choose another path, then make the sheet with generate --verify {out} --contact-sheet PATH"
        ) from error
    print(f"{contact_sheet}: contact sheet")


def matrix_sentence(matrix: ColourMatrix, camera: str, *, is_chosen: bool) -> str:
    """Return the name and the source of the colour matrix, with a warning if it was fitted to the LUT."""
    from generator.rendering.matrices import TABLE

    sentence = f"colour matrix: {matrix.name} ({matrix.source})"
    if matrix.name != TABLE:
        return sentence
    reason = "" if is_chosen else f"there is no published matrix for {camera}, so this one was fitted to the LUT; "
    return (
        f"{sentence}; {reason}if the print was made without colour management, the matrix contains its colour errors. "
        "Use --matrix NAME or FILE for the matrix of a camera"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with `argv`, or the arguments of the program if None, and return its exit code.

    `foundation.console.EXIT_CODES` lists the codes.
    """
    return run(lambda: app(None if argv is None else list(argv), prog_name="generate"), pause_gc=True)


if __name__ == "__main__":
    raise SystemExit(main())
