"""`evaluate paper`: the experiments of the paper's section 4, a command each, with its numbers beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evaluation.commands.options import (
    AngularError,
    Read,
    argument,
    choose_learners,
    image_steps,
    open_data,
    split_names,
    thread_option,
)
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, new_app, option, with_json
from foundation.errors import FormatError, InputError
from foundation.folders import require_free

if TYPE_CHECKING:
    from evaluation.experiments.paper.reporting import PaperReport
    from evaluation.scene import SceneSet
    from generator import Lut
    from generator.pictures.sources import Source

HELP = f"""Repeat the experiments of the paper's section 4.

N. Banic et al., "CroP: Color constancy benchmark dataset generator". Every command prints its numbers, the paper's
beside them where it has some, and with --out writes a page, CSV, LaTeX and figures to a new folder. docs/paper.md holds
all of them as made with full tables of both cameras.

{EXIT_CODES}
"""

app = new_app(no_args_is_help=True)

Luts = Annotated[list[Path], argument("LUT", "Folders of tables; demo: for a small computed one.")]
Kind = Annotated[AngularError, typer.Option(help="Angular error to print.")]
Out = Annotated[Path | None, option("FOLDER", "Write page, tables and figures here.")]
Workers = Annotated[int | None, thread_option()]

_NOT_C1 = (
    "The paper's pictures and ground truths are C1, the 259 images of the Canon 1Ds Mark III of NUS; its numbers stand "
    "beside data sets of C1 or random scenes under lights like those of C1 or random ones only."
)

_TABLE1 = f"""Plain methods on eight generated data sets (table 1).

Reads LUTs, the pictures and the ground truths. Generates, in memory, two sets of scenes, the pictures and as many of
random codes, under two choices of lights for each LUT: the nearest to the ground truths, and lights drawn at random.
Prints each method's six numbers for each of the data sets, the paper's below those of C1 and of random ones.
Writes nothing unless asked with --out.

{EXIT_CODES}
"""


@app.command("table1", help=_TABLE1)
@with_json("evaluate paper table1")
def table1(
    luts: Luts,
    pictures: Annotated[
        str,
        option(
            "PLACE",
            "The scenes: a folder of photographs, or a real data set, whose raw images are developed to sRGB "
            "with their ground truths.",
        ),
    ],
    lights_like: Annotated[
        str,
        option(
            "TRUTHS",
            "Ground truths whose nearest lights are one choice of lights: FILE.csv, FILE.csv#START for the rows "
            "whose names begin so, or a data set.",
        ),
    ],
    matrix: Annotated[
        str,
        option(
            "CAMERA|FILE|none",
            "Colour matrix by which a data set in --pictures is developed: a camera such as Canon EOS-1Ds Mark "
            "III, or a file of 3 x 3 numbers, linear sRGB to camera RGB.",
        ),
    ] = "none",
    side: Annotated[int, option("PX", "Longest side of every image.", min=1, max=65535)] = 512,
    sizes: Annotated[str, option("LIST", "Further sides, px, between commas, to show what they change.")] = "",
    error: Kind = "reproduction",
    seed: Annotated[int, option("N", "Of all that is drawn at random.", min=0)] = 0,
    out: Out = None,
    workers: Workers = None,
    *,
    output: JsonOutput,
) -> None:
    """Run plain methods on eight generated data sets."""
    from evaluation.experiments.paper.material import read_truths
    from evaluation.experiments.paper.published import cell_name
    from evaluation.experiments.paper.reporting import table1_report
    from evaluation.experiments.paper.table1 import settings, size_dependence
    from evaluation.experiments.paper.table1 import table1 as run

    sides = _sides(sizes)
    _require_free(out)
    opened = _open(luts)
    scenes, says, called = _pictures(pictures, matrix)
    truths = read_truths(lights_like)
    names = cell_name(called, [scene.name for scene in scenes]), cell_name(truths.name, truths.images)
    chosen = settings(opened, scenes, truths.lights, side, seed, names)
    threads = workers or processor_count()
    with image_steps(sum(len(part.scenes) for part in chosen)) as step:
        blocks = run(chosen, threads, step)
    found = size_dependence(opened, scenes, truths.lights, sides, seed, threads, names)
    conditions = (
        f"Pictures: {says}. Images: longest side {side} px. Lights like those of {truths.name}. Seed {seed}.",
        f"Tables: {'; '.join(map(_says, opened))}.",
        *(() if names == ("C1", "C1") else (_NOT_C1,)),
    )
    _finish(table1_report(blocks, opened, conditions, error, found), conditions, out, output)


def _says(lut: Lut) -> str:
    origin = "" if lut.provenance.computed is None else ", computed and not photographed"
    return f"{lut.provenance.camera}, {len(lut.white)} lights{origin}, {lut.folder}"


_TABLE2 = f"""Learned methods trained on real and on generated images (table 2).

Reads the real DATA, in the paper Cube+, and a generated data set. Trains each method on both, by cross-validation on
the real one, and tests on the real one. The paper's numbers stand beside those of Cube+ only; on any data set
`evaluate transfer` compares more trainings. Writes nothing unless asked with --out.

{EXIT_CODES}
"""


@app.command("table2", help=_TABLE2)
@with_json("evaluate paper table2")
def table2(
    data: Annotated[str, typer.Argument(metavar="DATA", help="Real data set; the paper's is Cube+.")],
    generated: Annotated[str, option("PLACE", "Data set made by generate, to train on.")],
    method: Annotated[
        str,
        option("LIST", "Methods that learn, between commas: names, module:Class or file.py:Class."),
    ] = "smart-color-cat, regression-trees, color-beaver",
    unseen: Annotated[
        bool, typer.Option("--unseen", help="Leave out generated images that show a picture of the test.")
    ] = False,
    error: Kind = "reproduction",
    out: Out = None,
    workers: Workers = None,
    read: Read = None,
    *,
    output: JsonOutput,
) -> None:
    """Train learned methods on real and on generated images."""
    from evaluation.datasets import open_scenes
    from evaluation.experiments.folds import choose_folds
    from evaluation.experiments.paper.reporting import table2_report
    from evaluation.experiments.paper.table1 import table2 as run
    from evaluation.experiments.paper.table1 import table2_tables
    from evaluation.experiments.transfer.plan import trainable_images

    _require_free(out)
    learners = {getattr(each, "key", each.name): each for each in choose_learners(split_names([method]))}
    real, made = open_data(data, read), open_scenes(generated)
    count = len(real.scenes)
    training, shared_images = trainable_images(made, real, unseen, real.name)
    fate = "left out" if unseen else "kept, as in the paper, whose generated images show the pictures that are tested"
    fates = (f"{shared_images}. They were {fate}.",) if shared_images else ()
    drawn, _ = choose_folds(real, "3", 0)
    with image_steps(2 * count) as step:
        found = run(real.scenes, training, learners, drawn, 0, workers or processor_count(), step)
    is_cube = real.layout == "cube-plus"
    conditions = (
        f"Real: {real.name}, {count} images, {int(drawn.max()) + 1} folds. Generated: {made.name}, {len(training)} "
        f"images. {error.capitalize()} error, degrees.",
        _treatment(real),
        *fates,
        *(() if is_cube else ("The paper's table is of Cube+, so only its ratios stand beside these.",)),
    )
    _finish(table2_report(table2_tables(found, error, real.name, is_cube), conditions), conditions, out, output)


_BITS = f"""Influence of colour reduction on methods (section 4.2).

Reads DATA. Its linear images are tone mapped to 8 bits by the Flash operator, 0 to 7 bits of each code set to zero, and
taken back to linear; each method's numbers are printed for every number of bits and for the images as they are. Writes
nothing unless asked with --out.

{EXIT_CODES}
"""


@app.command("bits", help=_BITS)
@with_json("evaluate paper bits")
def bits(
    data: Annotated[str, typer.Argument(metavar="DATA", help="Real data set of linear images; the paper's is NUS C1.")],
    sigma: Annotated[float, option("PX", "Scale of Gray-Edge; 6 is usual for images of full size.", min=0.1)] = 6.0,
    error: Kind = "reproduction",
    out: Out = None,
    workers: Workers = None,
    read: Read = None,
    *,
    output: JsonOutput,
) -> None:
    """Run methods on images whose colours were reduced."""
    from evaluation.experiments.paper.colour_reduction import paper_methods, remove_bits
    from evaluation.experiments.paper.reporting import bits_report

    _require_free(out)
    opened = open_data(data, read)
    with image_steps(len(opened.scenes)) as step:
        found = remove_bits(opened.scenes, paper_methods(sigma), workers=workers or processor_count(), on_scene=step)
    first = f"{opened.name}, {len(opened.scenes)} images. Gray-Edge at a scale of {sigma:g} px."
    conditions = (first, _treatment(opened))
    _finish(bits_report(found, error, opened.name, conditions), conditions, out, output)


_REDUCTION = f"""One picture with 0 to 7 bits of each code set to zero (a figure of section 4.2).

Reads PICTURE. Prints how many colours are left and how far from the picture. Writes nothing unless asked with --out;
the figure is there only.

{EXIT_CODES}
"""


@app.command("reduction", help=_REDUCTION)
@with_json("evaluate paper reduction")
def reduction(
    picture: Annotated[Path, argument("PICTURE", "Any picture file.")], out: Out = None, *, output: JsonOutput
) -> None:
    """Show a picture with its colours reduced."""
    from evaluation.experiments.paper.reporting import reduction_report
    from generator import read_picture

    _require_free(out)
    _finish(reduction_report(read_picture(picture), picture.name), (), out, output)


_CHROMATICITIES = f"""Chromaticities of tables' lights as their cameras see them (figures of section 3.3).

Reads LUTs, and ground truths of real data sets. Prints how near the lights come to those. Writes nothing unless asked
with --out; the figure is there only.

{EXIT_CODES}
"""


@app.command("chromaticities", help=_CHROMATICITIES)
@with_json("evaluate paper chromaticities")
def chromaticities(
    luts: Luts,
    truths: Annotated[
        list[str] | None,
        option(
            "TRUTHS", "Ground truths to show beside the lights: FILE.csv, FILE.csv#START, or a data set. Repeatable."
        ),
    ] = None,
    out: Out = None,
    *,
    output: JsonOutput,
) -> None:
    """Show the chromaticities of tables' lights."""
    from evaluation.experiments.paper.material import read_truths
    from evaluation.experiments.paper.reporting import chromaticities_report

    _require_free(out)
    report = chromaticities_report(_open(luts), [read_truths(place) for place in truths or ()])
    _finish(report, (), out, output)
    if out is None:
        print("Name a folder with --out for the figure.")


def _treatment(data: SceneSet) -> str:
    """Return what was done to a data set's images before a method sees them, in a sentence."""
    return f"{'; '.join(f'{what}: {how}' for what, how in data.treatment.items())}."


def _finish(report: PaperReport, conditions: Sequence[str], out: Path | None, output: JsonOutput) -> None:
    from evaluation.experiments.paper.reporting import write_report
    from evaluation.reports.table_output import show_notes, show_tables

    if out is not None:
        write_report(report, out)
    show_notes(output, conditions)
    for table in report.tables:
        if not output.asked:
            print()
        show_tables(output, [table])
    if out is not None:
        print(f"\n{out / 'report.html'}")


def _open(folders: Sequence[Path]) -> list[Lut]:
    from generator import open_lut

    return [open_lut(folder) for folder in folders]


def _pictures(place: str, matrix: str) -> tuple[Sequence[Source], str, str]:
    """Return the source pictures at a place, what was done to get them, and their name."""
    from evaluation.datasets import open_scenes
    from evaluation.datasets.opening import layout_of
    from evaluation.experiments.paper.material import develop_sources
    from generator import find_pictures
    from generator.rendering.matrices import choose_matrix

    chosen = choose_matrix(matrix)
    try:
        layout = layout_of(place)
    except FormatError:
        layout = None
    if layout is None:
        if chosen is not None:
            raise InputError(f"--matrix {matrix} is for a data set of raw images; {place} is none")
        found = find_pictures(place)
        return found, f"{len(found)} of {place}", Path(place).resolve().name
    if layout == "generated":
        raise InputError(f"{place} was made by generate; name photographs, or a data set of real raw images")
    data = open_scenes(place, layout)
    how = f"with the colour matrix of {chosen.name}" if chosen else "without a colour matrix"
    return develop_sources(data, chosen), f"{len(data.scenes)} of {data.name}, developed to sRGB {how}", data.name


def _sides(text: str) -> list[int]:
    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if not part.isdigit() or not 1 <= int(part) <= 65535:
            raise InputError(f"{part!r} is no side of an image, px; write whole numbers from 1 to 65535 between commas")
    return [int(part) for part in parts]


def _require_free(out: Path | None) -> None:
    if out is not None:
        require_free(out, "the report")
