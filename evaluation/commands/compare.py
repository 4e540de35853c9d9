"""`evaluate compare`: two methods on the same images, or one method in two runs."""

from __future__ import annotations

import json
from contextlib import suppress
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evaluation.commands.options import (
    AngularError,
    Figures,
    argument,
    choose_learners,
    choose_methods,
    require_results_folder,
)
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from evaluation.experiments.comparing import MatchedErrors
    from evaluation.metrics import ErrorKind
    from evaluation.results.files import MethodErrors

HELP = f"""Compare two methods on the same images, or one method in two runs, image by image.

Reads one or two RESULTS: results folders, or their errors.csv. With one, compares all pairs of its methods; with two,
each method that both contain. Images of one group, such as one picture under several illuminants, count as one case.

Prints Wilcoxon's signed-rank test. For up to three comparisons also prints differences and ratios of all statistics
with bootstrap intervals, and the images with the largest differences. Writes files only with --out.

{EXIT_CODES}
"""


@with_json("evaluate compare")
def compare(
    results: Annotated[list[str], argument("RESULTS", "Results folder, or its errors.csv.")],
    method: Annotated[
        list[str] | None,
        option(
            "NAME",
            "Method to compare, by its name in the tables or in evaluate run; repeat the option for several methods. "
            "With two RESULTS, FIRST=SECOND compares methods of different names. \\[default: all]",
        ),
    ] = None,
    error: Annotated[AngularError, typer.Option(help="Angular error to compare.")] = "reproduction",
    out: Annotated[Path | None, option("FOLDER", "Write tables and scatter plots to this new folder.")] = None,
    figures: Figures = None,
    *,
    output: JsonOutput,
) -> None:
    """Compare methods on the same images."""
    from evaluation.experiments import comparing
    from evaluation.reports.table_output import show_notes, show_tables
    from evaluation.results.files import read_errors

    if len(results) > 2:
        raise InputError(f"{len(results)} RESULTS are given, expected one or two; omit the others")
    require_results_folder(out, "the comparison", figures)
    runs = [read_errors(location) for location in results]
    pairs = _match_pairs(runs, results, method, error)
    comparisons = comparing.compare(pairs)
    notes = [*dict.fromkeys(note for pair in pairs for note in pair.notes), *_treatment_notes(results)]
    if out is not None:
        comparing.write_comparisons(out, comparisons, notes, figures)
    show_notes(output, notes)
    verdicts = [comparing.verdict(comparison) for comparison in comparisons]
    output.add(results=results, error=error, verdicts=verdicts)
    show_tables(output, [comparing.tests_table(comparisons)])
    for sentence in verdicts:
        print(sentence)
    if output.is_requested or len(comparisons) <= comparing.MAX_DETAILED:
        show_tables(output, [comparing.statistics_table(comparisons)])
        show_tables(output, [comparing.images_table(comparison, 5) for comparison in comparisons])
    if out is not None:
        print(f"written to {out}: report.html, tests.csv, statistics.csv, tables.tex")


def _match_pairs(
    runs: Sequence[Mapping[str, MethodErrors]], locations: Sequence[str], names: Sequence[str] | None, error: ErrorKind
) -> list[MatchedErrors]:
    """Return the pairs to compare: all pairs of methods in one run, or each method that two runs share."""
    from evaluation.experiments.comparing import match

    run_a, run_b = runs[0], runs[-1]
    if len(runs) == 1:
        chosen_names = [_run_method(run_a, name, locations[0]) for name in names or run_a]
        pairs = list(combinations(dict.fromkeys(chosen_names), 2))
    elif names:
        texts = [(name, name) if name in run_a and name in run_b else name.partition("=")[::2] for name in names]
        pairs = [(_run_method(run_a, a, locations[0]), _run_method(run_b, b or a, locations[1])) for a, b in texts]
    elif len(run_a) == len(run_b) == 1:
        pairs = [(next(iter(run_a)), next(iter(run_b)))]
    else:
        pairs = [(name, name) for name in run_a if name in run_b]
    if not pairs:
        methods = " and ".join(f"{name} has {', '.join(run)}" for name, run in zip(locations, runs, strict=True))
        raise InputError(f"{methods}, expected two to compare; give a second RESULTS, or --method FIRST=SECOND")
    suffixes = ["", ""] if len(runs) == 1 else [f" ({location})" for location in locations]
    return [match(run_a[a], run_b[b], (a + suffixes[0], b + suffixes[1]), error) for a, b in dict.fromkeys(pairs)]


def _run_method(run: Mapping[str, MethodErrors], name: str, location: str) -> str:
    """Return the name of the method as it is written in the run; `name` may differ in upper and lower case."""
    same_names = [method for method in run if method.lower() in (name.lower(), _table_name(name).lower())]
    if len(same_names) != 1 and name not in run:
        raise InputError(f"{location} has no method {name!r}, expected one of {', '.join(run)}; correct --method")
    return name if name in run else same_names[0]


def _table_name(name: str) -> str:
    """Return the name in tables for an option value such as "pca"; return other names unchanged."""
    for choose in (choose_methods, choose_learners):
        with suppress(InputError):
            return choose([name])[0].name
    return name


def _treatment_notes(locations: Sequence[str]) -> list[str]:
    # If two runs treated the images differently, their errors differ even for the same method.
    first, second = (_read_treatment(location) for location in (locations[0], locations[-1]))
    differences = [aspect for aspect in first if aspect in second and first[aspect] != second[aspect]]
    return [f"the runs differ in {aspect}: first {first[aspect]}, second {second[aspect]}" for aspect in differences]


def _read_treatment(location: str) -> dict[str, Any]:
    """Return location and treatment of the images from the run.json of a run; empty if the file cannot be read."""
    path = Path(location) if Path(location).is_dir() else Path(location).parent
    try:
        record = json.loads((path / "run.json").read_text(encoding="utf-8"))
        return {"images": record["data_set"]["place"], **record["treatment"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
