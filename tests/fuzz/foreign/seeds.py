"""Small intact folders of each kind that can be received from others; fuzzing starts from them."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibration.table.lut import Lut, Provenance, SourceFrame, Unfit, frames_sha256, open_lut
from calibration.table.writing import LutWriter
from calibration.table.zarr_store import publish
from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.chart.layout import design_chart
from experiment.config import LabSettings
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.records import Check, Judgement, plan_steps
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights
from generator.masks.making import parse_masks
from generator.pictures.random_scenes import random_scenes

if TYPE_CHECKING:
    from typing import BinaryIO

LIGHTS = tuple(Illuminant(number, "uniform", None, Colour(255, 200, 9 * number)) for number in range(3))
FRAMES = [SourceFrame("light", light.index, f"frames/{light.index}.dng", f"{light.index}" * 64) for light in LIGHTS]

# The files of a folder by name.
Seed = dict[str, bytes]


def files_of(folder: Path) -> Seed:
    """Return the files below a folder by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def make_seeds(work: Path) -> dict[str, Seed]:
    """Return intact folders by kind: ``table``, ``published``, ``session``, ``dataset …``."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    lut = _table(work / "table")
    publish(lut, str(work / "published"))
    _session(work / "session")
    two_lights = SimultaneousLights(ListedLights((0, 1)), 2, parse_masks("half-plane", 2, 1))
    scenes = random_scenes(2, 12, 8)
    options = {
        "dataset folder": DatasetOptions(rendering="codes", split=(0.5, 0.5, 0.0)),
        "dataset tiff": DatasetOptions(rendering="codes", form="tiff", previews=False, crops=1),
        "dataset exr": DatasetOptions(rendering="codes", form="exr", previews=False),
        "dataset tar": DatasetOptions(rendering="codes", layout="webdataset", shard_images=2),
        "dataset parquet": DatasetOptions(rendering="codes", layout="parquet", shard_images=2),
    }
    for kind, dataset_options in options.items():
        lights = two_lights if kind in ("dataset folder", "dataset tar") else ListedLights((0, 2))
        generate_dataset(lut, work / kind, scenes, lights, options=dataset_options)
    return {path.name: files_of(path) for path in sorted(work.iterdir())}


def _table(folder: Path) -> Lut:
    folder.mkdir()
    (folder / "report.json").write_text('{"format": "crop.report"}\n')
    writer = LutWriter(folder, len(LIGHTS), 8, 4)
    rng = np.random.default_rng(1)
    for light in range(len(LIGHTS)):
        writer.put(light, rng.integers(100, 9000, (8, 4, 3)).astype(np.uint16))
    provenance = Provenance(
        camera="Test",
        bits=1,
        white_level=11000,
        session_sha256=frames_sha256(FRAMES),
        chart_sha256="2" * 64,
        software="test 1",
        unfit=[Unfit(colour=3, cause="a test")],
    )
    references = "light,name,r,g,b,r_error,g_error,b_error\n0,white,9000,9000,9000,1,1,1\n"
    writer.finish(LIGHTS, np.full((len(LIGHTS), 3), 9000.0), provenance, FRAMES, {"references.csv": references})
    return open_lut(folder)


def _session(folder: Path) -> None:
    settings = LabSettings(rig="simulated", chart=Path("chart.json"), illuminations=Path("illuminations.csv"))
    steps = plan_steps(LIGHTS, 25)
    time = datetime(2026, 1, 1, tzinfo=UTC)
    with Session.create(folder, settings.to_toml(), design_chart(bits=1), LIGHTS, steps) as session:
        for step in steps:
            time += timedelta(seconds=2)
            stem = f"{step.number:04d}_{step.kind}"
            attempt = session.journal.begin(step, f"frames/{stem}", time)

            def fill(stream: BinaryIO, number: int = step.number, time: datetime = time) -> CapturedFrame:
                return CapturedFrame("a.CR2", stream.write(b"raw %d" % number), time)

            checks = (Check("light", 0.1, None, 0.5, "degrees", ""),)
            judgement = Judgement(checks, seen=(1.0, 2.0, 3.0))
            received = session.receive(stem, fill)
            session.journal.commit(attempt, received, judgement, {"expose": 0.5}, exposure_s=0.5, ended_at=time)
        session.journal.note(time, "paused", "a test")
        session.journal.beat("ended", "it ended", time)
        session.journal.record("camera", "Test")
        session.write_frames_csv()
