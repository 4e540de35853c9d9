"""The secrets of a store's address are in no file of a data set that is made there, nor on the terminal."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
from fsspec.implementations.memory import MemoryFileSystem
from fsspec.registry import register_implementation

PASSWORD = "ftp-5ecret-word"


class GuardedStore(MemoryFileSystem):
    """A store whose address holds a user and a password, as ftp's and sftp's do."""

    protocol = "guarded"
    store: dict[str, object] = {}  # noqa: RUF012  as fsspec has it
    pseudo_dirs = [""]  # noqa: RUF012  as fsspec has it

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return f"/{path.rpartition('@')[2].removeprefix('guarded://').strip('/')}".rstrip("/")


def command(module: str, *arguments: object) -> int:
    return int(import_module(module).main([*map(str, arguments)]))


def test_no_file_of_a_data_set_holds_the_secret_of_its_address(
    table_and_picture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    register_implementation("guarded", GuardedStore, clobber=True)
    address = f"guarded://lab:{PASSWORD}@store/"
    store = GuardedStore()
    store.pipe_file("/store/pictures/cat.png", (table_and_picture / "cat.png").read_bytes())
    arguments = ("--sources", address + "pictures", "--light", "0", "--light", "1", "--workers", 1)
    assert command("generator.cli", table_and_picture / "lut", address + "out", *arguments) == 0
    assert command("generator.cli", "--verify", address + "out") == 0
    assert command("generator.cli", table_and_picture / "lut", address + "out", *arguments) in (0, 2)
    assert command("generator.cli", "--verify", address + "nowhere") == 2
    told = "".join(capsys.readouterr())
    assert "guarded://…@store/out" in told
    assert PASSWORD not in told
    names = store.find("/store/out")
    assert len(names) > 6
    for name in names:
        assert PASSWORD.encode() not in store.cat_file(name), name
