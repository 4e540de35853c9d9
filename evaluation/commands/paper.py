"""`evaluate paper`: experiments of section 4 of the paper, with the published numbers for comparison."""

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

N. Banic et al., "CroP: Color constancy benchmark dataset generator". Every command prints its results and, if there are
any, the published numbers. With --out it writes a page, CSV, LaTeX and figures to a new folder. docs/paper.md contains
the results with full look-up tables (LUT) of both cameras.

{EXIT_CODES}
"""

app = new_app(no_args_is_help=True)

# Arguments and options that several commands share.
Luts = Annotated[list[Path], argument("LUT", "Folders of look-up tables (LUT), or demo: for a small computed LUT.")]
ErrorOption = Annotated[AngularError, typer.Option(help="Angular error to print.")]
Out = Annotated[Path | None, option("FOLDER", "Write page, tables and figures here.")]
Workers = Annotated[int | None, thread_option()]

# Printed with the conditions if pictures or ground truths differ from those of the paper.
_NOT_C1_NOTE = (
    "The paper uses C1, the 259 images of the Canon 1Ds Mark III of NUS, for pictures and ground truths. "
    "Published numbers are shown only if both scenes and illuminants are from C1 or random."
)

_TABLE1_HELP = f"""Statistics-based methods on eight generated data sets (table 1).

Reads LUTs, pictures and ground truths. Generates four data sets for each LUT in memory. The scenes are the pictures, or
as many scenes of random codes. The illuminants are those nearest to the ground truths, or random ones. Prints the
statistics of each method for each data set, followed by the published statistics for C1 and random scenes. Writes files
only with --out.

{EXIT_CODES}
"""


@app.command("table1", help=_TABLE1_HELP)
@with_json("evaluate paper table1")
def table1(
    luts: Luts,
    pictures: Annotated[
        str,
        option(
            "PLACE",
            "Scenes: a folder of photographs, or a real data set; its raw images are developed to sRGB with their "
            "ground truths.",
        ),
    ],
    lights_like: Annotated[
        str,
        option(
            "TRUTHS",
            "Ground truths; the illuminants nearest to them are used: FILE.csv, FILE.csv#START for rows with names "
            "that begin with START, or a data set.",
        ),
    ],
    matrix: Annotated[
        str,
        option(
            "CAMERA|FILE|none",
            "Colour matrix for developing a data set in --pictures: a camera such as Canon EOS-1Ds Mark "
            "III, or a file of 3 x 3 numbers, linear sRGB to camera RGB.",
        ),
    ] = "none",
    side: Annotated[int, option("PX", "Longest side of every image.", min=1, max=65535)] = 512,
    sizes: Annotated[str, option("LIST", "Further image sides, px, separated by commas.")] = "",
    error: ErrorOption = "reproduction",
    seed: Annotated[int, option("N", "Seed of all random choices.", min=0)] = 0,
    out: Out = None,
    workers: Workers = None,
    *,
    output: JsonOutput,
) -> None:
    """Run statistics-based methods on eight generated data sets."""
    from evaluation.experiments.paper.material import read_truths
    from evaluation.experiments.paper.published import name_in_table1
    from evaluation.experiments.paper.reporting import table1_report
    from evaluation.experiments.paper.table1 import plan_blocks, size_dependence
    from evaluation.experiments.paper.table1 import table1 as run

    sides = _parse_sides(sizes)
    _require_free(out)
    opened = _open_luts(luts)
    scenes, pictures_text, pictures_name = _open_pictures(pictures, matrix)
    truths = read_truths(lights_like)
    names = name_in_table1(pictures_name, [scene.name for scene in scenes]), name_in_table1(truths.name, truths.images)
    data_sets = plan_blocks(opened, scenes, truths.lights, side, seed, names)
    threads = workers or processor_count()
    with image_steps(sum(len(data_set.scenes) for data_set in data_sets)) as step:
        blocks = run(data_sets, threads, step)
    size_rows = size_dependence(opened, scenes, truths.lights, sides, seed, threads, names)
    conditions = (
        f"Pictures: {pictures_text}. Images: longest side {side} px. Illuminants like {truths.name}. Seed {seed}.",
        f"LUTs: {'; '.join(map(_lut_text, opened))}.",
        *(() if names == ("C1", "C1") else (_NOT_C1_NOTE,)),
    )
    _show(table1_report(blocks, opened, conditions, error, size_rows), conditions, out, output)


def _lut_text(lut: Lut) -> str:
    origin = "" if lut.provenance.computed is None else ", computed and not photographed"
    return f"{lut.provenance.camera}, {len(lut.white)} illuminants{origin}, {lut.folder}"


_TABLE2_HELP = f"""Learned methods trained on real and on generated images (table 2).

Reads the real DATA, in the paper Cube+, and a generated data set. Trains each method on both, with cross-validation on
DATA, and tests it on DATA. The published numbers are printed only for Cube+. `evaluate transfer` compares more kinds of
training, for any data set. Writes files only with --out.

{EXIT_CODES}
"""


@app.command("table2", help=_TABLE2_HELP)
@with_json("evaluate paper table2")
def table2(
    data: Annotated[str, typer.Argument(metavar="DATA", help="Real data set; the paper's is Cube+.")],
    generated: Annotated[str, option("PLACE", "Data set made by generate, to train on.")],
    method: Annotated[
        str, option("LIST", "Learned methods, separated by commas: names, module:Class or file.py:Class.")
    ] = "smart-color-cat, regression-trees, color-beaver",
    unseen: Annotated[
        bool, typer.Option("--unseen", help="Exclude generated images with a picture that is also a test image.")
    ] = False,
    error: ErrorOption = "reproduction",
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
    learners = {getattr(learner, "key", learner.name): learner for learner in choose_learners(split_names([method]))}
    real, generated_set = open_data(data, read), open_scenes(generated)
    count = len(real.scenes)
    training, shared_images = trainable_images(generated_set, real, unseen, real.name)
    treatment_text = "excluded" if unseen else "kept, because generated images of the paper also show test pictures"
    shared_notes = (f"{shared_images}. They were {treatment_text}.",) if shared_images else ()
    # Three folds, as in the published tables for Cube+.
    folds, _ = choose_folds(real, "3", 0)
    with image_steps(2 * count) as step:
        comparisons = run(real.scenes, training, learners, folds, 0, workers or processor_count(), step)
    is_cube = real.layout == "cube-plus"
    conditions = (
        f"Real: {real.name}, {count} images, {int(folds.max()) + 1} folds. Generated: {generated_set.name}, "
        f"{len(training)} images. {error.capitalize()} error, degrees.",
        _treatment_text(real),
        *shared_notes,
        *(() if is_cube else ("The published errors are for Cube+. Of them, only the ratios of medians are shown.",)),
    )
    _show(table2_report(table2_tables(comparisons, error, real.name, is_cube), conditions), conditions, out, output)


_BITS_HELP = f"""Influence of colour reduction on methods (section 4.2).

Reads DATA. Its linear images are tone mapped to 8 bits by the Flash operator, 0 to 7 bits of each code are set to zero,
and the inverse operator gives linear images. Prints the statistics of each method for every number of bits and for the
unchanged images. Writes files only with --out.

{EXIT_CODES}
"""


@app.command("bits", help=_BITS_HELP)
@with_json("evaluate paper bits")
def bits(
    data: Annotated[str, typer.Argument(metavar="DATA", help="Real data set of linear images; the paper's is NUS C1.")],
    sigma: Annotated[float, option("PX", "Scale of Gray-Edge; 6 is usual for images of full size.", min=0.1)] = 6.0,
    error: ErrorOption = "reproduction",
    out: Out = None,
    workers: Workers = None,
    read: Read = None,
    *,
    output: JsonOutput,
) -> None:
    """Run methods on images with reduced colours."""
    from evaluation.experiments.paper.colour_reduction import paper_methods, remove_bits
    from evaluation.experiments.paper.reporting import bits_report

    _require_free(out)
    opened = open_data(data, read)
    with image_steps(len(opened.scenes)) as step:
        result = remove_bits(opened.scenes, paper_methods(sigma), workers=workers or processor_count(), on_scene=step)
    description = f"{opened.name}, {len(opened.scenes)} images. Gray-Edge at a scale of {sigma:g} px."
    conditions = (description, _treatment_text(opened))
    _show(bits_report(result, error, opened.name, conditions), conditions, out, output)


_REDUCTION_HELP = f"""One picture with 0 to 7 bits of each code set to zero (a figure of section 4.2).

Reads PICTURE. Prints the number of remaining colours and the peak signal-to-noise ratio. Writes files, including the
figure, only with --out.

{EXIT_CODES}
"""


@app.command("reduction", help=_REDUCTION_HELP)
@with_json("evaluate paper reduction")
def reduction(
    picture: Annotated[Path, argument("PICTURE", "Any picture file.")], out: Out = None, *, output: JsonOutput
) -> None:
    """Show a picture with its colours reduced."""
    from evaluation.experiments.paper.reporting import reduction_report
    from generator import read_picture

    _require_free(out)
    _show(reduction_report(read_picture(picture), picture.name), (), out, output)


_CHROMATICITIES_HELP = f"""Chromaticities of the illuminants of look-up tables (LUT) in camera RGB (section 3.3).

Reads LUTs, and ground truths of real data sets. Prints the angles from the ground truths to the nearest illuminants.
Writes files, including the figure, only with --out.

{EXIT_CODES}
"""


@app.command("chromaticities", help=_CHROMATICITIES_HELP)
@with_json("evaluate paper chromaticities")
def chromaticities(
    luts: Luts,
    truths: Annotated[
        list[str] | None,
        option("TRUTHS", "Ground truths for comparison: FILE.csv, FILE.csv#START, or a data set. Repeatable."),
    ] = None,
    out: Out = None,
    *,
    output: JsonOutput,
) -> None:
    """Show the chromaticities of the illuminants of LUTs."""
    from evaluation.experiments.paper.material import read_truths
    from evaluation.experiments.paper.reporting import chromaticities_report

    _require_free(out)
    report = chromaticities_report(_open_luts(luts), [read_truths(location) for location in truths or ()])
    _show(report, (), out, output)
    if out is None:
        print("The figure was not written; use --out FOLDER to write it.")


def _treatment_text(data: SceneSet) -> str:
    return f"{'; '.join(f'{aspect}: {text}' for aspect, text in data.treatment.items())}."


def _show(report: PaperReport, conditions: Sequence[str], out: Path | None, output: JsonOutput) -> None:
    from evaluation.experiments.paper.reporting import write_report
    from evaluation.reports.table_output import show_notes, show_tables

    if out is not None:
        write_report(report, out)
    show_notes(output, conditions)
    for table in report.tables:
        if not output.is_requested:
            print()
        show_tables(output, [table])
    if out is not None:
        print(f"\n{out / 'report.html'}")


def _open_luts(folders: Sequence[Path]) -> list[Lut]:
    from generator import open_lut

    return [open_lut(folder) for folder in folders]


def _open_pictures(location: str, matrix: str) -> tuple[Sequence[Source], str, str]:
    """Return the source pictures at a location, a text on their origin, and the name of their set."""
    from evaluation.datasets import open_scenes
    from evaluation.datasets.opening import layout_of
    from evaluation.experiments.paper.material import develop_sources
    from generator import find_pictures
    from generator.rendering.matrices import choose_matrix

    colour_matrix = choose_matrix(matrix)
    try:
        layout = layout_of(location)
    except FormatError:
        layout = None
    if layout is None:
        if colour_matrix is not None:
            raise InputError(f"--matrix {matrix} needs a data set of raw images, {location} is not one; omit --matrix")
        pictures = find_pictures(location)
        return pictures, f"{len(pictures)} of {location}", Path(location).resolve().name
    if layout == "generated":
        raise InputError(f"{location} was made by generate, expected photographs or real raw images; give others")
    data = open_scenes(location, layout)
    matrix_text = f"with the colour matrix of {colour_matrix.name}" if colour_matrix else "without a colour matrix"
    text = f"{len(data.scenes)} of {data.name}, developed to sRGB {matrix_text}"
    return develop_sources(data, colour_matrix), text, data.name


def _parse_sides(text: str) -> list[int]:
    sides = [side.strip() for side in text.split(",") if side.strip()]
    for side in sides:
        if not side.isdigit() or not 1 <= int(side) <= 65535:
            raise InputError(f"side {side!r} of an image: expected a whole number from 1 to 65535 px; correct --sizes")
    return [int(side) for side in sides]


def _require_free(out: Path | None) -> None:
    if out is not None:
        require_free(out, "the report")
