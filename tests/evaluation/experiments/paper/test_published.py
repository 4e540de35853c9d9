"""Published numbers, compared with the source of the paper."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from evaluation.experiments.paper.published import TABLE1, TABLE2, PublishedRow

PAPERS = [path for folder in Path(__file__).parents if (path := folder / "shared" / "paper.tex").is_file()]
"""The paper's source, where it lies beside a developer's checkout; it is not ours to ship."""

ROW = re.compile(r"^\s*([A-Z][^\n&]*?)~\\cite\{[^}]*\} & ([\d.& ]+)\\\\", re.MULTILINE)
BLOCK = re.compile(r"\\multicolumn\{7\}\{\|c\|\}\{")

ALL = [(f"{key}, {method}", row) for key, rows in [*TABLE1.items(), *TABLE2.items()] for method, row in rows.items()]


def printed(text: str) -> list[tuple[str, dict[str, PublishedRow]]]:
    """Return the heading and the rows of each block of both tables."""
    _, *blocks = BLOCK.split(text)
    # The last block of the first table is followed by the text, where no row stands.
    return [
        (
            block.split("\\\\")[0].replace("\\makecell{", "").strip("}{ \n"),
            {name: PublishedRow(*map(float, numbers.split("&"))) for name, numbers in ROW.findall(block)},
        )
        for block in blocks
    ]


# Where the paper's source is not at hand the table's inner consistency below is what holds.
@pytest.mark.parametrize("path", PAPERS[:1])
def test_numbers_match_paper_source(path: Path) -> None:
    blocks = printed(path.read_text())
    assert len(blocks) == len(TABLE1) + len(TABLE2) == 10
    for (head, rows), (key, ours) in zip(blocks, TABLE1.items(), strict=False):
        words = [value.strip("~ ") for value in head.split(",")]
        assert [word.split()[0] for word in words] == list(key)
        assert [word.split()[1] for word in words] == ["scenes", "sensor", "illuminations"]
        assert rows == ours
    (head, rows), (theirs, moved) = blocks[8:]
    assert "cross-validation" in head
    assert "generated" in theirs
    assert rows == TABLE2["real"]
    assert moved == TABLE2["generated"]


@pytest.mark.parametrize(("name", "row"), ALL, ids=[name for name, _ in ALL])
def test_average_is_geometric_mean(name: str, row: PublishedRow) -> None:
    *values, average = row.as_tuple()
    low = math.prod(value - 0.005 for value in values) ** 0.2
    high = math.prod(value + 0.005 for value in values) ** 0.2
    assert low - 0.005 <= average <= high + 0.005
    assert row.best25 < row.median < row.worst25


def test_published_row_exceeds_reproduction_error() -> None:
    # White corrected to a single channel is as far from white as the error can be.
    largest = math.degrees(math.acos(1 / math.sqrt(3)))
    beyond = [(key, method) for key, rows in TABLE1.items() for method, row in rows.items() if row.worst25 > largest]
    assert beyond == [(("Random", "550D", "Random"), "White-Patch")]
