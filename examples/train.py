"""Train a small network to see the light, from scratch, in minutes on a processor; and hold it against statistics.

    pip install torch
    python examples/train.py LUT [--train FOLDER --test FOLDER] [--steps 1500]

The table's lights and the pictures are divided: every fifth light and the test pictures are never trained on. Without
folders, photographs that come with scikit-image are used; more of your own make a better network. At the end both are
tried on the same crops of the test pictures under the lights held out.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import torch
from torch.utils.data import DataLoader

from calibration.table.lut import open_lut
from evaluation.methods import standard_methods
from evaluation.metrics import recovery_error, summarise
from generator.pictures.sources import find_pictures
from generator.training import Crops, Gallery, gallery_of
from generator.training.torch_crops import CropDataset, collated

SIDE = 64
BATCH = 64
TRAINED_ON = ("astronaut", "chelsea", "hubble_deep_field", "immunohistochemistry", "retina", "stereo_motorcycle")
TRIED_ON = ("coffee", "rocket")


def photographs(names: tuple[str, ...]) -> Gallery:
    """Return photographs of scikit-image."""
    taken = [getattr(skimage.data, name)() for name in names]
    pictures = [np.asarray(one[0] if isinstance(one, tuple) else one, dtype=np.uint8) for one in taken]
    return gallery_of([np.ascontiguousarray(picture[..., :3]) for picture in pictures], names)


def gallery_from(folder: Path) -> Gallery:
    """Return the pictures of a folder that are large enough."""
    scenes = [(source.name, source.read().picture) for source in find_pictures([folder])]
    large = [(name, picture) for name, picture in scenes if min(picture.shape[:2]) >= SIDE]
    return gallery_of([picture for _, picture in large], [name for name, _ in large])


def network() -> Any:
    """Return a network from crops (N, 3, side, side) to four maps: a light for each place, and how far to trust it."""
    nn = torch.nn
    return nn.Sequential(
        *(nn.Conv2d(3, 32, 5, stride=2), nn.ReLU()),
        *(nn.Conv2d(32, 64, 3, stride=2), nn.ReLU()),
        *(nn.Conv2d(64, 64, 3, stride=2), nn.ReLU()),
        nn.Conv2d(64, 4, 1),
    )


def light_of(model: Any, image: Any) -> Any:
    """Return the lights (N, 3), of unit length, that the network sees in crops."""
    # How bright a crop is says nothing of the light's colour; roots spread the dark values that linear light crowds.
    level = image.mean(dim=(1, 2, 3), keepdim=True).clamp_min(1e-6)
    maps = model((image / level).clamp(0, 8).sqrt())
    light = torch.nn.functional.softplus(maps[:, :3])
    seen = (light * torch.sigmoid(maps[:, 3:])).mean(dim=(2, 3))
    return torch.nn.functional.normalize(seen, dim=1)


def train(model: Any, crops: Crops, steps: int, workers: int) -> None:
    """Fit the network by the cosine of the angle to the ground truth."""
    optimiser = torch.optim.AdamW(model.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=2e-3, total_steps=steps)
    loader = DataLoader(CropDataset(crops), batch_size=BATCH, num_workers=workers, collate_fn=collated)
    start = time.perf_counter()
    running = 1.0
    for step, batch in enumerate(loader, start=1):
        truth = torch.nn.functional.normalize(batch["illuminant"], dim=1)
        loss = 1 - (light_of(model, batch["image"]) * truth).sum(dim=1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        running += 0.02 * (loss.item() - running)
        if step % 250 == 0 or step == steps:
            angle = np.degrees(np.arccos(1 - min(running, 1.0)))
            print(f"step {step:5}  about {angle:5.2f}°  {time.perf_counter() - start:4.0f} s", flush=True)


def main() -> None:
    """Train, try, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lut", type=Path, help="folder of a table")
    parser.add_argument("--train", type=Path, help="folder of pictures to train on")
    parser.add_argument("--test", type=Path, help="folder of pictures to try on; none of them among the others")
    parser.add_argument("--steps", type=int, default=1500, help="batches of 64 crops")
    parser.add_argument("--workers", type=int, default=0, help="processes that draw crops beside the training")
    chosen = parser.parse_args()
    torch.manual_seed(0)
    lut = open_lut(chosen.lut)
    lights = range(len(lut.samples))
    held_out = [light for light in lights if light % 5 == 2]
    training = photographs(TRAINED_ON) if chosen.train is None else gallery_from(chosen.train)
    trial = photographs(TRIED_ON) if chosen.test is None else gallery_from(chosen.test)
    crops = Crops(
        lut,
        training,
        (SIDE, SIDE),
        length=chosen.steps * BATCH,
        lights=[light for light in lights if light not in held_out],
        exposure=(0.5, 1.0),
    )
    model = network()
    train(model, crops, chosen.steps, chosen.workers)
    tried = Crops(lut, trial, (SIDE, SIDE), length=1024, lights=held_out, exposure=(0.5, 1.0), seed=1)
    batch = tried.batch(np.arange(len(tried)))
    with torch.no_grad():
        found = {"this network": light_of(model, torch.from_numpy(batch.images)).numpy()}
    # A single light that is always guessed is what a network must beat before it can be said to see anything.
    guess = np.stack([lut.ground_truth[light] for light in lights if light not in held_out]).mean(axis=0)
    found["always the mean light"] = np.broadcast_to(guess, batch.illuminants.shape)
    pictures = batch.images.transpose(0, 2, 3, 1)
    for name in ("gray-world", "white-patch", "shades-of-gray", "gray-edge-1"):
        method = standard_methods()[name]
        found[method.name] = np.stack([method.estimate(picture, 0.98) for picture in pictures])
    print(
        f"\n{len(tried)} crops of {len(trial)} unseen pictures under {len(held_out)} unseen illuminants, angle in "
        "degrees"
    )
    print(f"{'':24}{'mean':>8}{'median':>8}{'worst 25 %':>12}")
    for name, lights_found in found.items():
        summary = summarise(recovery_error(lights_found, batch.illuminants))
        print(f"{name:24}{summary.mean:8.2f}{summary.median:8.2f}{summary.worst25:12.2f}")


if __name__ == "__main__":
    main()
