"""Damaged and hostile folders are read or refused; `tests/fuzz/fuzz_folders.py` tries a million of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.foreign.seeds import Seed, make_seeds
from tests.fuzz.foreign.trial import READERS, Trials

pytestmark = pytest.mark.slow

# Mutated folders per kind, a few seconds; earlier failures are listed in KNOWN.
COUNT = 8

KNOWN = (
    ("dataset folder", 73),  # a list of hashes that names a file of a terabyte without a byte
    ("dataset folder", 1710),  # a mask of a thousand million pixels in a hundred bytes
    ("dataset folder", 1002141),  # a folder that became a link before one of its files was changed
    ("dataset parquet", 1000236),  # an image whose name has no ending
    ("dataset parquet", 1004394),  # an image whose name is a path
    ("dataset tiff", 85),
    ("dataset tar", 1685),  # a name of 70 000 characters, in a message
    ("session", 126),  # settings that are a link to a file outside
    ("session", 128),  # a chart of a terabyte without a byte
    ("session", 1864),  # a number of 5000 digits
    ("session", 2981),
    ("session", 1007352),  # a schema that is no text, quoted in the message of SQLite
    ("session", 1010533),  # a chart with a colour of thirty digits
    ("published", 1448),
)


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Trials:
    return Trials(tmp_path_factory.mktemp("work"))


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Seed]:
    return make_seeds(tmp_path_factory.mktemp("work") / "seeds")


@pytest.mark.parametrize("reader", sorted(READERS))
def test_mutated_folders_are_read_or_refused(trials: Trials, seeds: dict[str, Seed], reader: str) -> None:
    kinds = [kind for kind in seeds if kind.split()[0] == reader]
    assert kinds
    for kind in kinds:
        for number in range(COUNT):
            assert trials.judge(kind, seeds[kind], number) is None, (kind, number)


@pytest.mark.parametrize(("kind", "number"), KNOWN)
def test_earlier_failures_stay_fixed(trials: Trials, seeds: dict[str, Seed], kind: str, number: int) -> None:
    assert trials.judge(kind, seeds[kind], number) is None


def test_reads_intact_folders(trials: Trials, seeds: dict[str, Seed], tmp_path: Path) -> None:
    for kind, seed in seeds.items():
        folder = tmp_path / kind
        for name, data in seed.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        with trials.watch.armed():
            READERS[kind.split()[0]](folder, tmp_path / f"spare {kind}")
