"""Train a network of your own on our data: `python examples/own_training.py DATASET [EPOCHS]`"""

import sys
from pathlib import Path

import torch
from nlos_models import Preprocess, split_and_stack
from torch import nn

from nlos_cam.dataset import open_dataset

BATCH = 8


def main(folder: Path, epochs: int = 3) -> None:
    """Train a small network from maps to silhouettes; DATASET is what `nlos-cam dataset build`
    wrote.
    """
    torch.manual_seed(0)
    data = open_dataset(folder)
    normal = Preprocess()
    maps = next(data.chunks())  # one shard is enough to estimate mean and spread
    normal.learn(split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)))
    layers = nn.Conv2d(4, 16, 5, 3), nn.ReLU(), nn.Conv2d(16, 32, 5, 3), nn.ReLU(), nn.Flatten()
    network = nn.Sequential(*layers, nn.Linear(32 * 10 * 10, 64 * 64))
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    error = nn.BCEWithLogitsLoss()
    for epoch in range(epochs):
        losses: list[float] = []
        for batch in data.batches(seed=0, epoch=epoch, batch=BATCH):
            guess = network(normal(batch.depth_m, batch.intensity))
            truth = batch.image.flatten(1) > 0
            optimiser.zero_grad()
            loss = error(guess, truth.float())
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
        print(f"epoch {epoch}: {sum(losses) / len(losses):.3f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:3]))
