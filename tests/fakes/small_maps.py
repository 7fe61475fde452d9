"""Images of plates, simplified maps of them, and networks that learn from them in a moment."""

from collections.abc import Iterator
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nlos_models import CheckpointRecord
from nlos_models import pipeline as networks
from nlos_models.arrays import Float16, Float32
from nlos_models.pipeline import RemappingNetwork
from nlos_models.training import checkpoints
from nlos_models.training.data import MapBatch, MapSet, first_of, map_batches
from nlos_models.training.recipe import recipe_of
from torch import Tensor, nn
from torch.nn import functional

LATENT = 256
HARD_MAPS = ("constant", "all zero", "saturated", "half invalid", "all invalid")


def small_images(count: int, seed: int) -> Float16:
    """Return images (n, 64, 64) of one bright square each."""
    generator = np.random.default_rng(seed)
    images = np.zeros((count, 64, 64), np.float16)
    for image in images:
        row, column = generator.integers(8, 30, 2)
        image[row : row + 24, column : column + 24] = generator.uniform(0.3, 1)
    return images


def small_maps(count: int, seed: int) -> MapSet:
    """Return the same images with maps (n, 64, 80) that show them, without returns beside them."""
    images = small_images(count, seed)
    intensity = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8))) * 50
    depth = np.where(intensity > 0, intensity / 100, np.float32(np.nan)).astype(np.float32)
    return MapSet(depth, intensity, images)


def noise_maps(count: int) -> tuple[Float32, Float32]:
    """Return depth and intensity (n, 64, 80) of noise by their count; a tenth of the cells have no
    return.
    """
    generator = np.random.default_rng(count)
    depth = generator.uniform(0.2, 0.8, (count, 64, 80)).astype(np.float32)
    depth[generator.random(depth.shape) < 0.1] = np.nan
    return depth, generator.uniform(0, 255, depth.shape).astype(np.float32)


def hard_maps(name: str, channels: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
    """Return depth (1, 64, 80) and intensity (1, *channels, 64, 80) at an extreme that a camera can
    deliver.
    """
    depth = torch.full((1, 64, 80), 0.3)
    intensity = torch.full((1, *channels, 64, 80), 10.0)
    if name == "all zero":
        depth = torch.zeros_like(depth)
        intensity = torch.zeros_like(intensity)
    if name == "saturated":
        intensity[:] = 255.0
    if name == "half invalid":
        depth[:, :, :40] = torch.nan
    if name == "all invalid":
        depth[:] = torch.nan
    return depth, intensity


class SmallDataset:
    """Stand-in for a dataset of two shards on disk, in a folder or in the current one."""

    def __init__(self, maps: MapSet, plan: Any, folder: Path = Path(), first_seed: int = 0) -> None:
        self._maps = maps
        self.plan = plan
        self.folder = folder
        self.seeds = set(range(first_seed, first_seed + len(maps.image)))

    def __len__(self) -> int:
        return len(self._maps.image)

    def as_recorded(self) -> "SmallDataset":
        return self

    def arrays(self) -> MapSet:
        return self._maps

    def first(self, count: int) -> MapSet:
        return first_of(self._maps, count)

    def up_to(self, count: int) -> "SmallDataset":
        return SmallDataset(self.first(count), self.plan, self.folder, min(self.seeds))

    def benches(self) -> Iterator[Any]:
        return repeat(self.plan.rig, len(self))

    def column(self, name: str) -> Any:
        return getattr(self._maps, name)

    def chunks(self) -> Iterator[MapSet]:
        maps = self._maps
        half = len(self) // 2
        for part in (slice(half), slice(half, None)):
            yield MapSet(maps.depth_m[part], maps.intensity[part], maps.image[part])

    def batches(self, seed: int, epoch: int, batch: int) -> Iterator[MapBatch]:
        return map_batches(self._maps, batch, torch.Generator().manual_seed(seed + epoch))


class SmallEncoder(nn.Module):
    """Stand-in for Encoder: coarse pixels, a batch norm, two linear maps."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(64)
        self.mean = nn.Linear(64, LATENT)
        self.log_variance = nn.Linear(64, LATENT)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        features = self.norm(functional.avg_pool2d(image, 8).flatten(1))
        return self.mean(features), self.log_variance(features).clamp(-2, 2)


class SmallDecoder(nn.Module):
    """Stand-in for Decoder: a batch norm, and one linear map to coarse pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(LATENT)
        self.output = nn.Linear(LATENT, 64)

    def forward(self, latent: Tensor) -> Tensor:
        coarse = self.output(self.norm(latent)).view(-1, 1, 8, 8)
        return torch.sigmoid(functional.interpolate(coarse, scale_factor=8))


class SmallVae(nn.Module):
    """Stand-in for ResVae."""

    latent = LATENT

    def __init__(self) -> None:
        super().__init__()
        self.encoder = SmallEncoder()
        self.decoder = SmallDecoder()

    def forward(self, image: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        mean, log_variance = self.encoder(image)
        return self.decoder(mean + noise * torch.exp(0.5 * log_variance)), mean, log_variance


class SmallCompressor(nn.Module):
    """Stand-in for Compressor of any width: features with a batch norm, then dropout and a linear
    classifier.
    """

    def __init__(self, dropout: float = 0.5, width: float = 1.0) -> None:  # noqa: ARG002  small is small
        super().__init__()
        conv = nn.Conv2d(4, 4, 5, stride=5)
        self.features = nn.Sequential(
            conv, nn.BatchNorm2d(4), nn.ReLU(), nn.AvgPool2d(4), nn.Flatten()
        )
        self.classifier = nn.Sequential(nn.Dropout(dropout), nn.Linear(100, LATENT))

    def forward(self, stacked: Tensor) -> Tensor:
        return self.classifier(self.features(stacked))


def use_small_networks(patch: pytest.MonkeyPatch, *modules: object) -> None:
    """Replace the networks by small ones, also in modules that import the classes."""
    small_ones = {
        "ResVae": SmallVae,
        "Encoder": SmallEncoder,
        "Decoder": SmallDecoder,
        "Compressor": SmallCompressor,
    }
    for module in (networks, *modules):
        for name, small in small_ones.items():
            patch.setattr(module, name, small, raising=False)


def untrained_weights(folder: Path, *, rig: Any, seed: int = 0, **recipe: Any) -> None:
    """Write a checkpoint of untrained small networks (see `use_small_networks`) with this
    recipe.
    """
    facts = {
        "objects": 10,
        "held_out": 2,
        "epochs": 1,
        "batch": 2,
        "learning_rate": 1e-3,
        "image_weight": 1.0,
    }
    facts |= {"latent_weight": 0.0} if recipe.get("steps") == "one" else {}
    made = recipe_of({"task": "compressor", **facts, **recipe})
    record = CheckpointRecord(
        rig_name=rig.name, rig_checksum=rig.checksum, input=made.maps, compressor_recipe=made
    )
    torch.manual_seed(seed)
    pipeline = RemappingNetwork(SmallCompressor(), SmallDecoder())  # type: ignore[arg-type]
    encoder = None if made.steps == "one" else SmallEncoder()
    checkpoints.save_pipeline(folder, pipeline, record, encoder)  # type: ignore[arg-type]
