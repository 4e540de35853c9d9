"""The measured data that tests read: each file is described, unchanged and small."""

from __future__ import annotations

import hashlib
import re

from tests.data_files import SHIPPED

LARGEST_MIB = 15


def test_the_readme_names_every_file_with_its_hash() -> None:
    text = (SHIPPED / "README.md").read_text(encoding="utf-8")
    named = dict(re.findall(r"^\| `(\S+)` \|.* `([0-9a-f]{64})` \|$", text, re.MULTILINE))
    local = SHIPPED / "local"
    files = [path for path in SHIPPED.rglob("*") if path.is_file() and local not in path.parents]
    found = {
        path.relative_to(SHIPPED).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.name != "README.md"
    }
    assert found == named
    assert sum(path.stat().st_size for path in files) < LARGEST_MIB << 20
