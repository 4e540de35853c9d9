"""The measured data of tests: each file is listed, unchanged and small."""

from __future__ import annotations

import hashlib
import re

from tests.data_files import SHIPPED

LARGEST_MIB = 15


def test_readme_lists_every_file_with_hash() -> None:
    text = (SHIPPED / "README.md").read_text(encoding="utf-8")
    listed_hashes = dict(re.findall(r"^\| `(\S+)` \|.* `([0-9a-f]{64})` \|$", text, re.MULTILINE))
    local = SHIPPED / "local"
    files = [path for path in SHIPPED.rglob("*") if path.is_file() and local not in path.parents]
    file_hashes = {
        path.relative_to(SHIPPED).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.name != "README.md"
    }
    assert file_hashes == listed_hashes
    assert sum(path.stat().st_size for path in files) < LARGEST_MIB << 20
