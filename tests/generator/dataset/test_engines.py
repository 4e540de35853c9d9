"""Engines: a dataset's bytes are the same whoever makes the shards, and however often one of them dies."""

from __future__ import annotations

import hashlib
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest

from foundation.errors import InputError
from generator.dataset.making import SILENT, Callbacks, Workers, generate_dataset, parse_engine
from generator.dataset.plan import DatasetOptions
from generator.lights.lighting import RandomLights
from generator.pictures.sources import find_pictures, random_scenes

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from distributed import LocalCluster

    from calibration.table.lut import Lut

IMAGES = 240
SHARD = 12


def contents(folder: Path) -> dict[str, str]:
    """Return the hash of every file below `folder`."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def make(lut: Lut, out: Path, engine: str, workers: int, on_image: Callable[[], None] | None = None) -> None:
    scenes = random_scenes(IMAGES // 2, 24, 16, 4)
    lights = RandomLights(2, 4, 4)
    generate_dataset(
        lut,
        out,
        scenes,
        lights,
        seed=4,
        options=DatasetOptions(previews=False, shard_images=SHARD, split=(0.8, 0.1, 0.1)),
        workers=Workers(engine, workers),
        callbacks=SILENT if on_image is None else Callbacks(on_image=on_image),
    )


@pytest.fixture
def undisturbed(make_lut: Callable[..., Lut], tmp_path: Path) -> tuple[Lut, dict[str, str]]:
    """Return a table, and the hashes of the files of a dataset that one thread made of it."""
    lut = make_lut()
    make(lut, tmp_path / "undisturbed", "local", 1)
    return lut, contents(tmp_path / "undisturbed")


def dask_workers() -> list[psutil.Process]:
    """Return the processes of this program's Dask workers."""
    below = psutil.Process().children(recursive=True)
    return [process for process in below if "spawn_main" in " ".join(process.cmdline())]


def test_a_killed_worker_changes_no_byte(undisturbed: tuple[Lut, dict[str, str]], tmp_path: Path) -> None:
    lut, expected = undisturbed
    killed: list[int] = []

    def kill_one() -> None:
        if not killed:
            victim = dask_workers()[0]
            victim.kill()
            killed.append(victim.pid)

    make(lut, tmp_path / "out", "dask", 2, kill_one)
    assert len(killed) == 1
    assert contents(tmp_path / "out") == expected
    assert not list(tmp_path.glob(".out*"))


PROGRAM = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from calibration.table.lut import open_lut
from test_engines import make

if __name__ == "__main__":
    seen = iter(range({images}))
    make(
        open_lut(Path({lut!r})), Path({out!r}), {engine!r}, 2,
        lambda: None if next(seen, None) is not None else os.kill(os.getpid(), signal.SIGKILL),
    )
"""


@pytest.mark.parametrize("engine", ["local", "dask"])
def test_a_killed_program_is_gone_on_with(undisturbed: tuple[Lut, dict[str, str]], tmp_path: Path, engine: str) -> None:
    lut, expected = undisturbed
    program = PROGRAM.format(
        tests=str(Path(__file__).parent),
        images=3 * SHARD,
        lut=str(lut.folder),
        out=str(tmp_path / "out"),
        engine=engine,
    )
    (tmp_path / "program.py").write_text(program)
    died = subprocess.run([sys.executable, tmp_path / "program.py"], capture_output=True, text=True, check=False)
    assert died.returncode == -signal.SIGKILL, died.stderr
    done = len(list((tmp_path / ".out.partial" / "plan" / "shards").glob("*.json")))
    assert 0 < done < IMAGES // SHARD
    made: list[None] = []
    make(lut, tmp_path / "out", "local", 2, lambda: made.append(None))
    assert len(made) <= IMAGES - SHARD * done, "what was done is not done again"
    assert contents(tmp_path / "out") == expected
    assert not list(tmp_path.glob(".out*"))


@pytest.fixture
def cluster(request: pytest.FixtureRequest) -> Iterator[LocalCluster]:
    """Return a cluster that is somebody else's, of one process, or of as many as are asked for."""
    import logging

    from distributed import LocalCluster

    with LocalCluster(
        n_workers=getattr(request, "param", 1),
        threads_per_worker=2,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        memory_limit=None,
        silence_logs=logging.CRITICAL,
    ) as cluster:
        yield cluster


def test_a_cluster_by_its_address(
    undisturbed: tuple[Lut, dict[str, str]], make_lut: Callable[..., Lut], tmp_path: Path, cluster: LocalCluster
) -> None:
    lut, expected = undisturbed
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    make(lut, tmp_path / "out", address, 1)
    assert contents(tmp_path / "out") == expected
    # A worker that finds another table at the same path says so.
    other = make_lut(name="other")
    assert other.sha256, "looked at before it is changed"
    shutil.rmtree(other.folder)
    make_lut(name="other", unfit=(3,))
    with pytest.raises(InputError, match="of a worker is not that of the plan; give every machine the same table"):
        generate_dataset(other, tmp_path / "refused", random_scenes(2, 24, 16), [0], workers=Workers(address))


@pytest.mark.parametrize("cluster", [0], indirect=True)
def test_a_scheduler_without_workers_is_named_and_waited_for(
    make_lut: Callable[..., Lut], tmp_path: Path, cluster: LocalCluster
) -> None:
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    said: list[str] = []

    def start_one(sentence: str) -> None:
        said.append(sentence)
        cluster.scale(1)

    scenes = random_scenes(2, 24, 16)
    made = generate_dataset(
        make_lut(), tmp_path / "out", scenes, [0], workers=Workers(address), callbacks=Callbacks(on_wait=start_one)
    )
    assert made.description.images == 2
    assert said == [f"the Dask scheduler has no worker yet; start some with: dask worker {cluster.scheduler_address}"]


def test_workers_that_were_started_in_another_folder(
    make_lut: Callable[..., Lut], tmp_path: Path, cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pictures").mkdir()
    Path("pictures/a.pgm").write_bytes(b"P5 2 2 255 abcd")
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    made = generate_dataset(make_lut(), Path("out"), find_pictures(["pictures"]), [0], workers=Workers(address))
    assert made.description.images == 1


@pytest.mark.parametrize(
    ("name", "address"), [("local", None), ("dask", ""), ("dask://node7:8786", "tcp://node7:8786")]
)
def test_names_of_engines(name: str, address: str | None) -> None:
    assert parse_engine(name) == address


@pytest.mark.parametrize("name", ["ray", "dask://", "dask://node7", "tcp://node7:8786", ""])
def test_an_unknown_engine_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="dask://HOST:PORT"):
        parse_engine(name)


def test_a_scheduler_that_does_not_answer(
    make_lut: Callable[..., Lut], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("generator.dataset.making.CONNECT_S", 0.2)
    with pytest.raises(InputError, match=r"127\.0\.0\.1:1"):
        generate_dataset(
            make_lut(), tmp_path / "out", random_scenes(2, 24, 16), [0], workers=Workers("dask://127.0.0.1:1")
        )
    assert [path.name for path in tmp_path.iterdir()] == ["lut"]
