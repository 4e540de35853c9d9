"""`evaluate compare`: two methods on the same images, or a method in two runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evaluation.commands.options import AngularError, argument
from foundation.console import EXIT_CODES, JsonOutput, option, with_json

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from evaluation.experiments.comparing import Comparison, Matched
    from evaluation.metrics import ErrorKind
    from evaluation.results.files import MethodErrors

_FEW = 3
"""Comparisons of which everything is printed unasked: of more, one would have to look for what they come to."""

HELP = f"""Compare two methods on the same images, or a method in two runs, image by image.

Reads one or two RESULTS: results folders, or the errors.csv in them. Of one, every two of its methods are compared; of
two, each method that both have. Images are matched by their names; images that one of them lacks are named and left
out, and ground truths that differ are refused.

Images of one group, such as one picture under several lights, count as one: whole groups are tested and drawn.

Prints Wilcoxon's signed-rank test and a sentence for each comparison; of up to three comparisons, and with --images of
all, also each statistic's difference and ratio with bootstrap intervals, and the images that differ most. Writes
nothing unless asked with --out.

{EXIT_CODES}
"""


@with_json("evaluate compare")
def compare(
    results: Annotated[list[str], argument("RESULTS", "Results folder, or its errors.csv.")],
    method: Annotated[
        list[str] | None,
        option(
            "NAME",
            "Method to compare, as the tables call it or by its name for evaluate run; give it more than once for "
            "several. With two RESULTS, FIRST=SECOND compares methods of different names. \\[default: all]",
        ),
    ] = None,
    error: Annotated[AngularError, typer.Option(help="Angular error to compare.")] = "reproduction",
    out: Annotated[
        Path | None,
        option(
            "FOLDER", "Write tables (CSV, LaTeX), the images' errors and a page with scatters to this new folder too."
        ),
    ] = None,
    images: Annotated[
        bool, typer.Option("--images", help="Print statistics and largest differences of more than three comparisons.")
    ] = False,
    level: Annotated[float, typer.Option(help="Confidence of the intervals.", min=0.5, max=0.999)] = 0.95,
    seed: Annotated[int, typer.Option(help="Of the bootstrap.", min=0)] = 0,
    *,
    output: JsonOutput,
) -> None:
    """Compare methods on the same images."""
    from evaluation.experiments import comparing
    from evaluation.reports.table_output import show_notes, show_tables
    from evaluation.results.files import read_errors
    from foundation.errors import InputError
    from foundation.folders import require_free

    if len(results) > 2:
        raise InputError(f"{len(results)} results; compare two, or the methods of one")
    if len(results) == 2 and len({_errors_file(place) for place in results}) == 1:
        raise InputError(
            f"{results[0]} and {results[1]} are the same results; evaluate compare {results[0]} compares its methods"
        )
    if out is not None:
        require_free(out, "the comparison")
    runs = [read_errors(place) for place in results]
    pairs = _of_one(runs[0], results[0], method, error) if len(runs) == 1 else _of_two(runs, results, method, error)
    comparisons = comparing.compare(pairs, seed, level)
    records = [_run_json(place) for place in results]
    notes = (
        *comparing.notes_of(comparisons),
        *_unchecked(runs, results),
        *_ungrouped(runs, results, records),
        *_unlike(records),
        *_guessed(runs, results),
        *_indistinct(comparisons, records),
    )
    if out is not None:
        comparing.write_comparisons(out, comparisons, notes, level)
    show_notes(output, notes)
    verdicts = [comparing.verdict(made, level) for made in comparisons]
    output.add(results=results, error=error, level=level, verdicts=verdicts)
    show_tables(output, [comparing.tests_table(comparisons)])
    for verdict in verdicts:
        print(verdict)
    if images or output.asked or len(comparisons) <= _FEW:
        for made in comparisons:
            show_tables(output, [comparing.statistics_table(made, level)])
            show_tables(output, [comparing.images_table(made, 5)])
    elif out is None:
        print("Statistics and images of each comparison: --images prints them, --out writes them, --method chooses.")
    if out is not None:
        print(f"written to {out}: report.html, tests.csv, statistics.csv, images.csv, tables.tex")


def _of_one(
    run: Mapping[str, MethodErrors], place: str, wanted: Sequence[str] | None, error: ErrorKind
) -> list[Matched]:
    """Return every two of the methods wanted, of one run."""
    from itertools import combinations

    from evaluation.experiments.comparing import match
    from foundation.errors import InputError

    chosen = list(dict.fromkeys(_named(run, name, place) for name in wanted or run))
    if len(chosen) < 2:
        raise InputError(
            f"{chosen[0]} of {place} alone; compare it with a second method (--method), or with a second run: "
            "evaluate compare RESULTS RESULTS"
        )
    return [match(run[one], run[other], (one, other), error) for one, other in combinations(chosen, 2)]


def _of_two(
    runs: Sequence[Mapping[str, MethodErrors]], places: Sequence[str], wanted: Sequence[str] | None, error: ErrorKind
) -> list[Matched]:
    """Return each method wanted, of one run and of the other."""
    from evaluation.experiments.comparing import match
    from foundation.errors import InputError

    one, other = runs
    if wanted:
        split = [(name, name) if name in one and name in other else name.partition("=")[::2] for name in wanted]
        chosen = [(_named(one, a, places[0]), _named(other, b or a, places[1])) for a, b in split]
    elif len(one) == len(other) == 1:
        chosen = [(next(iter(one)), next(iter(other)))]
    else:
        chosen = [(name, name) for name in one if name in other]
    if not chosen:
        raise InputError(
            f"{places[0]} has {', '.join(one)} and {places[1]} has {', '.join(other)}; say which to compare: "
            "--method FIRST=SECOND"
        )
    labels = _labels(places)
    return [
        match(one[a], other[b], (f"{a} ({labels[0]})", f"{b} ({labels[1]})"), error) for a, b in dict.fromkeys(chosen)
    ]


def _named(run: Mapping[str, MethodErrors], name: str, place: str) -> str:
    """Return the method's name as the run writes it; letters large or small are the same."""
    from foundation.errors import InputError

    if name in run:
        return name
    alike = [known for known in run if known.lower() in (name.lower(), _title(name).lower())]
    if len(alike) != 1:
        raise InputError(f"{place} has no method {name!r}; it has {', '.join(run)}")
    return alike[0]


def _title(name: str) -> str:
    """Return how tables call a method of this suite that has a short name: "pca"; any other name as it is."""
    import re

    from evaluation.learning.standard import standard_learners
    from evaluation.methods.naming import find_method
    from evaluation.methods.standard import local_methods, standard_methods

    learners = standard_learners()
    if name in learners:
        return learners[name].name
    known = {*standard_methods(), *local_methods()}
    return find_method(name).name if re.split("[:@]", name)[0] in known else name


def _errors_file(place: str) -> Path:
    path = Path(place).resolve()
    return path / "errors.csv" if path.is_dir() else path


def _labels(places: Sequence[str]) -> tuple[str, str]:
    """Return the shortest ends of two paths that tell them apart; 1 and 2 if they are the same place."""
    one, other = (
        [part for part in Path(place).absolute().parts if part not in ("errors.csv", "/")] for place in places
    )
    for length in range(1, max(len(one), len(other)) + 1):
        ends = "/".join(one[-length:]), "/".join(other[-length:])
        if ends[0] != ends[1]:
            return ends
    return "1", "2"


def _unchecked(runs: Sequence[Mapping[str, MethodErrors]], places: Sequence[str]) -> list[str]:
    """Return a sentence for each file without ground truths."""
    return [
        f"{place} holds no ground truths: whether they agree is not known"
        for run, place in zip(runs, places, strict=True)
        if len(runs) == 2 and any(method.truths is None for method in run.values())
    ]


def _ungrouped(runs: Sequence[Mapping[str, MethodErrors]], places: Sequence[str], records: Sequence[Any]) -> list[str]:
    """Return a sentence for results of generated images that do not say which are of one picture.

    Results of before `groups` stood in `run.json` have no column of groups even where images share their pictures.
    """
    if any(method.groups is not None for run in runs for method in run.values()):
        return []
    return [
        f"{place} does not say which images are of one picture: where some are, they are not independent, and p and "
        "intervals are too small; run the methods again to have them counted by picture"
        for place, record in zip(places, records, strict=True)
        if _said(record, "data_set", "layout") == "generated" and _said(record, "data_set", "groups") is None
    ]


def _unlike(records: Sequence[Any]) -> list[str]:
    """Return a sentence for each thing that two runs did otherwise to the images: not only the methods then differ."""
    done: list[dict[str, str]] = []
    for record in records:
        place, treatment = _said(record, "data_set", "place"), _said(record, "treatment")
        if place is None or not isinstance(treatment, dict):
            return []
        done.append({what: str(how) for what, how in {"images": place, **treatment}.items()})
    if len(done) < 2:
        return []
    one, other = done
    differing = [what for what in one if what in other and one[what] != other[what]]
    return [
        f"the runs differ in their {what}: {one[what]} in the first, {other[what]} in the second" for what in differing
    ]


def _said(record: Any, *names: str) -> Any:
    """Return what a run.json says below names; None where it does not say."""
    for name in names:
        record = record.get(name) if isinstance(record, dict) else None
    return record


def _run_json(place: str) -> Any:
    """Return the content of a results folder's run.json; an empty object if it has none that can be read."""
    import json

    path = Path(place)
    try:
        return json.loads((path if path.is_dir() else path.parent).joinpath("run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _indistinct(comparisons: Sequence[Comparison], records: Sequence[Any]) -> list[str]:
    """Return a sentence for each comparison whose medians differ by less than ground truths may be off by."""
    stated = [_said(record, "data_set", "truth_uncertainty_deg") for record in records]
    known = max((float(one) for one in stated if isinstance(one, int | float)), default=None)
    if known is None:
        return []
    medians = [
        (made, next(one.difference[0] for one in made.statistics if one.statistic == "median")) for made in comparisons
    ]
    return [
        "the medians of {} and {} differ by ".format(*made.matched.names)
        + f"{abs(apart):.2g} degrees, less than the {known:.2g} that ground truths may be off by (k = 2)"
        for made, apart in medians
        if abs(apart) < known
    ]


def _guessed(runs: Sequence[Mapping[str, MethodErrors]], places: Sequence[str]) -> list[str]:
    """Return a sentence for each method that gave no light for some images."""
    from foundation.errors import counted

    return [
        f"{name} of {place} gave no light for {method.guessed.sum()} of {counted(len(method.images), 'image')}; "
        "grey stands in"
        for run, place in zip(runs, places, strict=True)
        for name, method in run.items()
        if method.guessed.any()
    ]
