"""Stores with folders of their own get the folders that files lie in; what a store raises while it connects is said."""

from __future__ import annotations

from collections.abc import Generator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from fsspec.implementations.memory import MemoryFileSystem
from fsspec.registry import register_implementation

from foundation.errors import InputError
from generator.stores import RemoteStore


class FolderedStore(MemoryFileSystem):
    """A store that takes a file only where its folder was made, as FTP servers do."""

    protocol = "ftp"
    store: dict[str, object] = {}  # noqa: RUF012  as fsspec has it
    pseudo_dirs = [""]  # noqa: RUF012  as fsspec has it
    made: set[str] = set()  # noqa: RUF012  of this test

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return f"/{path.removeprefix('ftp://').strip('/')}".rstrip("/")

    def makedirs(self, path: str, exist_ok: bool = False) -> None:
        del exist_ok
        self.made.add(path.rstrip("/"))

    def _require(self, path: str) -> None:
        if path.rpartition("/")[0] not in self.made:
            raise EOFError("550 No such file or directory")

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **kwargs: Any) -> None:
        self._require(path)
        super().pipe_file(path, value)

    def put_file(self, lpath: str, rpath: str, **kwargs: Any) -> None:
        self._require(rpath)
        super().pipe_file(rpath, Path(lpath).read_bytes())


@pytest.fixture
def foldered() -> Generator[FolderedStore]:
    before = import_module("fsspec").get_filesystem_class("ftp")
    register_implementation("ftp", FolderedStore, clobber=True)
    FolderedStore.made.clear()
    yield FolderedStore()
    register_implementation("ftp", before, clobber=True)


def test_parents_are_made(table_and_picture: Path, foldered: FolderedStore) -> None:
    arguments = ["lut", "ftp://host/deep/out", "--sources", "cat.png", "--light", "0", "--workers", "1"]
    assert import_module("generator.cli").main(arguments) == 0
    assert "/host/deep/out/images" in foldered.made
    assert import_module("generator.cli").main(["--verify", "ftp://host/deep/out"]) == 0


def test_what_a_store_raises_while_it_connects_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    import ftplib

    def refuse(url: str) -> None:
        raise ftplib.error_perm("530 Login incorrect.")

    monkeypatch.setattr("fsspec.core.url_to_fs", refuse)
    with pytest.raises(InputError, match=r"cannot reach ftp://…@host/x: 530 Login incorrect; name a store"):
        RemoteStore("ftp://u:p@host/x")
