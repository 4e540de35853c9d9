"""Files that were once accepted, or ended in a traceback: each is refused with a reason."""

from __future__ import annotations

import zipfile
from collections import Counter
from pathlib import Path

import pytest

from drivers.raw.rawfile import decode_raw, filled_fault
from foundation.errors import FormatError
from tests.data_files import shipped
from tests.fuzz.raw import run, seeds

with zipfile.ZipFile(shipped("raw/found.zip")) as _kept:
    FOUND = {name: _kept.read(name) for name in _kept.namelist()}


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_is_refused(name: str) -> None:
    """By reading, or by what import, judge and build ask of a frame that was read."""
    try:
        mosaic = decode_raw(FOUND[name], Path(name))
    except FormatError:
        return
    assert filled_fault(mosaic.counts, mosaic.black, mosaic.white_level) is not None


@pytest.mark.slow
def test_the_search_for_more_runs() -> None:
    tally = Counter[str]()
    assert list(run(seeds(None), 5, range(100), tally)) == []
    assert tally.total() == 100
    assert {outcome.rpartition(": ")[2] for outcome in tally} == {"accepted", "refused"}
