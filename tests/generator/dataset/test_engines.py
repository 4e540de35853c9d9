"""Engines: a dataset's bytes are the same whoever makes the shards, and however often one of them dies."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest

from foundation.errors import InputError
from generator.dataset.making import Workers, generate_dataset, parse_engine
from generator.dataset.plan import DatasetOptions
from generator.dataset.shards import SILENT, Callbacks
from generator.lights.lighting import RandomLights
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import find_pictures
from tests.generator.conftest import MakeLut, lut_in
from tests.generator.dataset.contents import contents

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from calibration.table.lut import Lut

IMAGES = 48
SHARD = 8


def make(lut: Lut, out: Path, engine: str, workers: int, callbacks: Callbacks = SILENT) -> None:
    scenes = random_scenes(IMAGES // 2, 24, 16, 4)
    lights = RandomLights(2, 4, 4)
    generate_dataset(
        lut,
        out,
        scenes,
        lights,
        seed=4,
        options=DatasetOptions(previews=False, rendering="codes", shard_images=SHARD, split=(0.8, 0.1, 0.1)),
        workers=Workers(engine, workers),
        callbacks=callbacks,
    )


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Lut, dict[str, str]]:
    """Return a table, and the hashes of the files of a dataset that one thread made of it."""
    folder = tmp_path_factory.mktemp("undisturbed")
    lut = lut_in(folder / "lut")
    make(lut, folder / "out", "local", 1)
    return lut, contents(folder / "out")


def dask_workers() -> list[psutil.Process]:
    """Return the processes of this program's Dask workers."""
    below = psutil.Process().children(recursive=True)
    # Where setproctitle is installed, Dask gives them a title in place of their command.
    titles = ("spawn_main", "dask")
    return [process for process in below if any(title in " ".join(process.cmdline()).lower() for title in titles)]


def test_a_killed_worker_changes_no_byte(undisturbed: tuple[Lut, dict[str, str]], tmp_path: Path) -> None:
    lut, expected = undisturbed
    killed: list[int] = []

    def kill_one() -> None:
        if not killed:
            victim = dask_workers()[0]
            victim.kill()
            killed.append(victim.pid)

    # The only one: what takes its place makes the rest.
    make(lut, tmp_path / "out", "dask", 1, Callbacks(on_image=kill_one))
    assert len(killed) == 1
    assert contents(tmp_path / "out") == expected
    assert not list(tmp_path.glob(".out*"))


def test_a_cluster_of_somebody_else_s(
    undisturbed: tuple[Lut, dict[str, str]],
    make_lut: MakeLut,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from distributed import LocalCluster

    lut, expected = undisturbed
    counted = iter(range(SHARD + 3))

    def stop() -> None:
        if next(counted, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(lut, tmp_path / "out", "local", 1, Callbacks(on_image=stop))
    with LocalCluster(
        n_workers=0,
        threads_per_worker=2,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        memory_limit=None,
        silence_logs=logging.CRITICAL,
    ) as cluster:
        address = cluster.scheduler_address.replace("tcp://", "dask://")
        said: list[str] = []
        found: list[int] = []
        reported: list[None] = []

        def start_one(sentence: str) -> None:
            said.append(sentence)
            cluster.scale(1)

        seen = Callbacks(on_done=found.append, on_image=lambda: reported.append(None), on_wait=start_one)
        make(lut, tmp_path / "out", address, 1, seen)
        assert contents(tmp_path / "out") == expected
        assert sum(found) > SHARD, "images of the shard that was begun count, too"
        assert sum(found) + len(reported) == IMAGES
        hint = f"the Dask scheduler has no worker yet; start some with: dask worker {cluster.scheduler_address}"
        assert said == [hint]
        # A worker that finds another table at the same path says so.
        other = make_lut(name="other")
        assert other.sha256, "looked at before it is changed"
        shutil.rmtree(other.folder)
        make_lut(name="other", unfit=(3,))
        with pytest.raises(InputError, match="same table"):
            generate_dataset(other, tmp_path / "refused", random_scenes(2, 24, 16), [0], workers=Workers(address))
        # The worker was started in another folder.
        monkeypatch.chdir(tmp_path)
        Path("pictures").mkdir()
        Path("pictures/a.pgm").write_bytes(b"P5 2 2 255 abcd")
        made = generate_dataset(lut, Path("relative"), find_pictures(["pictures"]), [0], workers=Workers(address))
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


def test_a_scheduler_that_does_not_answer(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("generator.dataset.making.CONNECT_S", 0.2)
    with pytest.raises(InputError, match=r"127\.0\.0\.1:1"):
        generate_dataset(
            make_lut(), tmp_path / "out", random_scenes(2, 24, 16), [0], workers=Workers("dask://127.0.0.1:1")
        )
    assert [path.name for path in tmp_path.iterdir()] == ["lut"]
