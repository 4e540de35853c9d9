"""Train a small network that estimates the illuminant, and compare it with statistics-based methods.

    pip install torch
    python examples/train.py LUT [--train FOLDER --test FOLDER] [--steps 1500]

The training takes minutes on a CPU. Every fifth illuminant of the LUT and the test pictures are not used for training.
Without folders, photographs of scikit-image are used; more pictures make the network more accurate. At the end all
methods are tested on the same crops of the test pictures under the illuminants that were not used.
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
TRAINING_NAMES = ("astronaut", "chelsea", "hubble_deep_field", "immunohistochemistry", "retina", "stereo_motorcycle")
TEST_NAMES = ("coffee", "rocket")


def photographs(names: tuple[str, ...]) -> Gallery:
    """Return photographs of scikit-image."""
    arrays = [getattr(skimage.data, name)() for name in names]
    pictures = [np.asarray(array[0] if isinstance(array, tuple) else array, dtype=np.uint8) for array in arrays]
    return gallery_of([np.ascontiguousarray(picture[..., :3]) for picture in pictures], names)


def gallery_from(folder: Path) -> Gallery:
    """Return the pictures of a folder that are large enough."""
    scenes = [(source.name, source.read().picture) for source in find_pictures([folder])]
    large = [(name, picture) for name, picture in scenes if min(picture.shape[:2]) >= SIDE]
    return gallery_of([picture for _, picture in large], [name for name, _ in large])


def network() -> Any:
    """Return a network from crops (N, 3, side, side) to maps (N, 4, …): the local illuminant and its confidence."""
    nn = torch.nn
    return nn.Sequential(
        *(nn.Conv2d(3, 32, 5, stride=2), nn.ReLU()),
        *(nn.Conv2d(32, 64, 3, stride=2), nn.ReLU()),
        *(nn.Conv2d(64, 64, 3, stride=2), nn.ReLU()),
        nn.Conv2d(64, 4, 1),
    )


def light_of(model: Any, image: Any) -> Any:
    """Return the estimated illuminants (N, 3) of crops, of unit length."""
    # Brightness has no information on the illuminant colour, so it is divided out. Square roots expand dark values.
    level = image.mean(dim=(1, 2, 3), keepdim=True).clamp_min(1e-6)
    maps = model((image / level).clamp(0, 8).sqrt())
    light = torch.nn.functional.softplus(maps[:, :3])
    estimate = (light * torch.sigmoid(maps[:, 3:])).mean(dim=(2, 3))
    return torch.nn.functional.normalize(estimate, dim=1)


def train(model: Any, crops: Crops, steps: int, workers: int) -> None:
    """Fit the network with the cosine of the angle to the ground truth as loss."""
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
    """Train, test and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lut", type=Path, help="folder of a LUT")
    parser.add_argument("--train", type=Path, help="folder of training pictures")
    parser.add_argument("--test", type=Path, help="folder of test pictures, different from the training pictures")
    parser.add_argument("--steps", type=int, default=1500, help="number of batches of 64 crops")
    parser.add_argument("--workers", type=int, default=0, help="processes that draw crops during training")
    options = parser.parse_args()
    torch.manual_seed(0)
    lut = open_lut(options.lut)
    lights = range(len(lut.samples))
    held_out = [light for light in lights if light % 5 == 2]
    training = photographs(TRAINING_NAMES) if options.train is None else gallery_from(options.train)
    test = photographs(TEST_NAMES) if options.test is None else gallery_from(options.test)
    crops = Crops(
        lut,
        training,
        (SIDE, SIDE),
        length=options.steps * BATCH,
        lights=[light for light in lights if light not in held_out],
        exposure=(0.5, 1.0),
    )
    model = network()
    train(model, crops, options.steps, options.workers)
    test_crops = Crops(lut, test, (SIDE, SIDE), length=1024, lights=held_out, exposure=(0.5, 1.0), seed=1)
    batch = test_crops.batch(np.arange(len(test_crops)))
    with torch.no_grad():
        estimates = {"this network": light_of(model, torch.from_numpy(batch.images)).numpy()}
    # Baseline: a constant estimate. A useful network has smaller errors.
    guess = np.stack([lut.ground_truth[light] for light in lights if light not in held_out]).mean(axis=0)
    estimates["constant mean illuminant"] = np.broadcast_to(guess, batch.illuminants.shape)
    pictures = batch.images.transpose(0, 2, 3, 1)
    for name in ("gray-world", "white-patch", "shades-of-gray", "gray-edge-1"):
        method = standard_methods()[name]
        estimates[method.name] = np.stack([method.estimate(picture, 0.98) for picture in pictures])
    print(
        f"\n{len(test_crops)} crops of {len(test)} unseen pictures under {len(held_out)} unseen illuminants, angle in "
        "degrees"
    )
    print(f"{'':24}{'mean':>8}{'median':>8}{'worst 25 %':>12}")
    for name, illuminants in estimates.items():
        summary = summarise(recovery_error(illuminants, batch.illuminants))
        print(f"{name:24}{summary.mean:8.2f}{summary.median:8.2f}{summary.worst25:12.2f}")


if __name__ == "__main__":
    main()
