"""`evaluate compare`: two methods on the same images, or a method in two runs."""

from __future__ import annotations

import json
from contextlib import suppress
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evaluation.commands.options import AngularError, argument, choose_learners, choose_methods
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.errors import InputError
from foundation.folders import require_free

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from evaluation.experiments.comparing import MatchedErrors
    from evaluation.metrics import ErrorKind
    from evaluation.results.files import MethodErrors

# Of more comparisons only the tests and sentences are printed.
_FEW = 3

HELP = f"""Compare two methods on the same images, or a method in two runs, image by image.

Reads one or two RESULTS: results folders, or the errors.csv in them. Of one, every two of its methods are compared; of
two, each method that both have. Images of one group, such as one picture under several lights, count as one.

Prints Wilcoxon's signed-rank test; of up to three comparisons also each statistic's difference and ratio with bootstrap
intervals, and the images that differ most. Writes nothing unless asked with --out.

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
    out: Annotated[Path | None, option("FOLDER", "Write tables and a page with scatters to this new folder.")] = None,
    *,
    output: JsonOutput,
) -> None:
    """Compare methods on the same images."""
    from evaluation.experiments import comparing
    from evaluation.reports.table_output import show_notes, show_tables
    from evaluation.results.files import read_errors

    if len(results) > 2:
        raise InputError(f"{len(results)} results; compare two, or the methods of one")
    if out is not None:
        require_free(out, "the comparison")
    runs = [read_errors(place) for place in results]
    pairs = _pairs(runs, results, method, error)
    comparisons = comparing.compare(pairs)
    notes = [*dict.fromkeys(note for pair in pairs for note in pair.notes), *_other_treatments(results)]
    if out is not None:
        comparing.write_comparisons(out, comparisons, notes)
    show_notes(output, notes)
    verdicts = [comparing.verdict(made) for made in comparisons]
    output.add(results=results, error=error, verdicts=verdicts)
    show_tables(output, [comparing.tests_table(comparisons)])
    for sentence in verdicts:
        print(sentence)
    if output.asked or len(comparisons) <= _FEW:
        show_tables(output, [comparing.statistics_table(comparisons)])
        show_tables(output, [comparing.images_table(made, 5) for made in comparisons])
    if out is not None:
        print(f"written to {out}: report.html, tests.csv, statistics.csv, tables.tex")


def _pairs(
    runs: Sequence[Mapping[str, MethodErrors]], places: Sequence[str], wanted: Sequence[str] | None, error: ErrorKind
) -> list[MatchedErrors]:
    """Return the pairs to compare: every two methods of one run, or each method of one run and of the other."""
    from evaluation.experiments.comparing import match

    one, other = runs[0], runs[-1]
    if len(runs) == 1:
        chosen = list(combinations(dict.fromkeys(_named(one, name, places[0]) for name in wanted or one), 2))
    elif wanted:
        split = [(name, name) if name in one and name in other else name.partition("=")[::2] for name in wanted]
        chosen = [(_named(one, a, places[0]), _named(other, b or a, places[1])) for a, b in split]
    elif len(one) == len(other) == 1:
        chosen = [(next(iter(one)), next(iter(other)))]
    else:
        chosen = [(name, name) for name in one if name in other]
    if not chosen:
        known = " and ".join(f"{place} has {', '.join(run)}" for place, run in zip(places, runs, strict=True))
        raise InputError(f"{known}: name two methods to compare, or one of each run: --method FIRST=SECOND")
    ends = ["", ""] if len(runs) == 1 else [f" ({place})" for place in places]
    return [match(one[a], other[b], (a + ends[0], b + ends[1]), error) for a, b in dict.fromkeys(chosen)]


def _named(run: Mapping[str, MethodErrors], name: str, place: str) -> str:
    """Return the method's name as the run writes it; letters large or small are the same."""
    alike = [known for known in run if known.lower() in (name.lower(), _title(name).lower())]
    if len(alike) != 1 and name not in run:
        raise InputError(f"{place} has no method {name!r}; it has {', '.join(run)}")
    return name if name in run else alike[0]


def _title(name: str) -> str:
    """Return the name in tables of a method of this suite that has a short name: "pca"; any other name as it is."""
    for choose in (choose_methods, choose_learners):
        with suppress(InputError):
            return choose([name])[0].name
    return name


def _other_treatments(places: Sequence[str]) -> list[str]:
    """Return what two runs did differently to the images: then not only the methods differ."""
    one, other = (_treatment(place) for place in (places[0], places[-1]))
    differing = [what for what in one if what in other and one[what] != other[what]]
    return [f"the runs differ in their {what}: first {one[what]}, second {other[what]}" for what in differing]


def _treatment(place: str) -> dict[str, Any]:
    """Return which images a run used and what it did to them, by its run.json; nothing if that cannot be read."""
    path = Path(place) if Path(place).is_dir() else Path(place).parent
    try:
        record = json.loads((path / "run.json").read_text(encoding="utf-8"))
        return {"images": record["data_set"]["place"], **record["treatment"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
