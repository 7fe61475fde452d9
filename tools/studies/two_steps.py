"""Two steps against one for the direct network: docs/two_steps.json.

`python tools/studies/two_steps.py --store DIR --dataset DIR --held-out DIR [--samples N] [--images N] KIND ...` trains
each kind on equal samples: one, bottle (one step through a latent), two (maps to the encoder's latent), frozen (decoder
from images, kept), joint (decoder from images, trained on). One thread.
"""

import json
from argparse import Namespace
from collections.abc import Callable, Sequence
from math import cos, pi
from pathlib import Path
from typing import Any

import harness
import numpy as np
import torch
from nlos_calibration import rig_named
from nlos_models import DirectNetwork, NormalBatch, first_of, load_recipe, run
from nlos_models.direct import PIXELS, SIDE_TOKENS, TOKEN, MirrorLinear, Residual, _patches, two_heads_error
from nlos_models.direct_training import _varied, repeat
from nlos_models.vae import kl_divergence, latent_error
from torch import Tensor, nn
from torch.nn import functional

from nlos_cam.dataset import PackedMaps, open_dataset, open_packed_maps
from nlos_cam.evaluate import over_objects, per_object, plain, rendered_objects

RECIPE = load_recipe(harness.ROOT / "models" / "recipes" / "paper-rig-direct.toml")
SIDE_LATENT, FEATURES, DIVERGENCE = 128, 64, 3e-3
TAIL = {"from_latent", "out", "place", "mixers", "norm", "heads"}
Loss = Callable[[NormalBatch], Tensor]


class Encoder(nn.Module):
    """Encoder from images (n, 64, 64) to mean and log-variance (n, 2, 128), alike for both sides."""

    def __init__(self) -> None:
        super().__init__()
        tokens = SIDE_TOKENS[0] * SIDE_TOKENS[1]
        self.patch, self.place = nn.Linear(2 * TOKEN**2, FEATURES), nn.Parameter(0.02 * torch.randn(tokens, FEATURES))
        mixers = list[nn.Module]()
        for _ in range(2):
            over_tokens = MirrorLinear(tokens, 2 * tokens), MirrorLinear(2 * tokens, tokens)
            over_features = nn.Linear(FEATURES, 2 * FEATURES), nn.Linear(2 * FEATURES, FEATURES)
            mixers += [Residual(FEATURES, over_tokens, 0.0, across=True), Residual(FEATURES, over_features, 0.0)]
        self.mixers, self.norm = nn.Sequential(*mixers), nn.LayerNorm(FEATURES)
        self.latent = MirrorLinear(tokens * FEATURES, 2 * SIDE_LATENT)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Encode images; 0 is background."""
        both = torch.stack([(image > 0).float(), image.float()], 1)
        sides = torch.stack([both[..., : PIXELS // 2, :], both[..., PIXELS // 2 :, :].flip(-2)], 1)
        x = functional.gelu(self.patch(_patches(sides, TOKEN).flatten(2, 3))) + self.place
        mean, log_variance = self.latent(self.norm(self.mixers(x)).flatten(2)).chunk(2, -1)
        return mean, log_variance.clamp(-10, 10)


class Bottle(DirectNetwork):
    """Direct network through a latent (n, 2, 128)."""

    def __init__(self) -> None:
        super().__init__(RECIPE.direct)
        self.latent_norm = nn.LayerNorm(self.size.width)
        self.to_latent = MirrorLinear(self.size.width, SIDE_LATENT)
        self.from_latent = MirrorLinear(SIDE_LATENT, self.size.width)

    def latent(self, normal: Tensor) -> Tensor:
        """Map normalised maps to latents."""
        sides = torch.stack([normal[..., :32, :], normal[..., 32:, :].flip(-2)], 1)
        x = functional.gelu(self.patch(_patches(sides, 4)))
        x = functional.gelu(self.merge(_patches(x.movedim(-1, 2), 2)))
        return self.to_latent(self.latent_norm(self.trunk(self.into(x.flatten(2)))))

    def decode(self, latent: Tensor) -> Tensor:
        """Map latents to two logits."""
        x = self.out(functional.gelu(self.from_latent(latent))).unflatten(-1, self.place.shape) + self.place
        x = self.heads(self.norm(self.mixers(x))).unflatten(-1, (2, TOKEN, TOKEN)).unflatten(2, SIDE_TOKENS)
        x = x.permute(0, 1, 4, 2, 5, 3, 6).reshape(-1, 2, 2, PIXELS // 2, PIXELS)
        return torch.cat([x[:, 0], x[:, 1].flip(-2)], -2)

    def logits(self, normal: Tensor) -> Tensor:
        """Map normalised maps to two logits."""
        return self.decode(self.latent(normal))

    def split(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """Return the parameters before the latent, and the decoder's."""
        named = list(self.named_parameters())
        parts = [[p for name, p in named if (name.split(".")[0] in TAIL) == last] for last in (False, True)]
        return parts[0], parts[1]


def fit(parameters: Sequence[nn.Parameter], source: PackedMaps, samples: int, loss: Loss) -> None:
    """Train as the recipe of the direct network does, and keep the moving average."""
    steps, generator = samples // RECIPE.batch, torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(parameters, RECIPE.learning_rate, (0.9, 0.98), weight_decay=RECIPE.weight_decay)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda k: min((k + 1) / RECIPE.warm_up_steps, 1) * (1 + cos(pi * min(1, k / steps))) / 2
    )
    means = [p.detach().clone() for p in parameters]
    for k, batch in enumerate(repeat(source, RECIPE.batch, steps, generator)):
        with torch.autocast("cpu", torch.bfloat16):
            value = loss(batch)
        optimizer.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            for mean, p in zip(means, parameters, strict=True):
                mean.lerp_(p, 1 - min(RECIPE.average, (k + 1) / (k + 10)))
    with torch.no_grad():
        for mean, p in zip(means, parameters, strict=True):
            p.copy_(mean)


def decoder_of(source: PackedMaps, images: int) -> tuple[Encoder, Bottle]:
    """Train a variational autoencoder on the images alone."""
    torch.manual_seed(0)
    encoder, network = Encoder(), Bottle()

    def loss(batch: NormalBatch) -> Tensor:
        mean, log_variance = encoder(batch.image)
        latent = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        divergence = kl_divergence(mean.flatten(1), log_variance.flatten(1))
        return two_heads_error(network.decode(latent), batch.image) + DIVERGENCE * divergence

    fit([*encoder.parameters(), *network.split()[1]], source, images, loss)
    return encoder.eval().requires_grad_(False), network


def trained(kind: str, source: PackedMaps, samples: int, start: tuple[Encoder, Bottle] | None) -> DirectNetwork:
    """Train one kind on maps."""
    torch.manual_seed(0)
    network = DirectNetwork(RECIPE.direct) if kind == "one" else Bottle()
    network.normal.load_state_dict(source.normal.state_dict())
    parameters = list(network.parameters())
    if start and isinstance(network, Bottle) and kind in {"two", "frozen", "joint"}:
        head, tail = network.split()
        with torch.no_grad():
            for own, theirs in zip(tail, start[1].split()[1], strict=True):
                own.copy_(theirs)
        parameters = parameters if kind == "joint" else head
        for p in tail:
            p.requires_grad_(kind == "joint")

    def loss(batch: NormalBatch) -> Tensor:
        normal = _varied(RECIPE, network.normal, batch.normal.float(), source.noise)
        normal = normal + RECIPE.noise * torch.randn_like(normal)
        if kind == "two" and start and isinstance(network, Bottle):
            mean, log_variance = start[0](batch.image)
            return latent_error(network.latent(normal).flatten(1), mean.flatten(1), log_variance.flatten(1)) / 100
        return two_heads_error(network.logits(normal), batch.image)

    fit(parameters, source, samples, loss)
    return network.eval()


def main(chosen: Namespace) -> None:
    """Train the kinds and write their figures after each."""
    rig, rows = rig_named("paper-rig"), list[dict[str, Any]]()
    sets = {"kinds": rendered_objects(rig).maps, "unseen": rendered_objects(rig, test="unseen").maps}
    sets["held_out"] = first_of(open_dataset(chosen.held_out).arrays(), 1000)
    torch.set_num_threads(1)
    with open_packed_maps(chosen.dataset, chosen.store) as source:
        start = decoder_of(source, chosen.images) if {"two", "frozen", "joint"} & set(chosen.kind) else None
        for kind in chosen.kind:
            network = trained(kind, source, chosen.samples, start)
            row = {"kind": kind, "objects": len(source), "samples": chosen.samples}
            for key, maps in sets.items():
                truth = maps.image.astype(np.float32)
                row[key] = plain(over_objects(per_object(run(network, maps), truth, source.plan.box)))
            rows.append(row)
            print(json.dumps(row), flush=True)
            chosen.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    parser = harness.options(__doc__)
    parser.add_argument("kind", nargs="+", choices=["one", "bottle", "two", "frozen", "joint"])
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--dataset", type=Path, action="append", required=True)
    parser.add_argument("--held-out", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=204800)
    parser.add_argument("--images", type=int, default=1024000)
    parser.add_argument("--out", type=Path, default=harness.DOCS / "two_steps.json")
    main(parser.parse_args())
