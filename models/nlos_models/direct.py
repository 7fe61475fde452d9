"""Direct network from maps to images: the project's own, beside the paper's pipeline; no latent,
two heads.

The rig is symmetric about y = 0, and so is the network: the answer to mirrored maps is the mirrored
answer, exactly. Maps are folded into two sides, top and bottom, the bottom one upside down; each
layer treats both sides alike. All layers are matrix products, which a CPU trains 14 times as fast
as MobileNetV2's convolutions.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from nlos_models.metrics import CUTS, MIN_V
from nlos_models.training.recipe import DirectSize

ROWS = 64
COLUMNS = 80
PIXELS = 64
CLIP = 5.0
"""Limit of a normalised cell, in spreads."""
SMALLEST_SHARE = 0.3
"""Smallest spread of a cell, as a share of the median spread: quiet cells would otherwise show
noise alone.
"""
MIN_LIGHT_SPREAD = 0.04
"""Of the log intensity: the reflectance of a real wall varies by some percent, which the renderer's
does not.
"""
GAIN_COLUMNS = 4
"""A frame's gain is taken from every fourth column of cells; from all rows, so that mirrored maps
have the same gain.
"""
PATCH = 4
TOKEN = 8
"""Cells of a patch's side, and pixels of an output token's side; patches are merged two by two."""
SIDE_PATCHES = (ROWS // 2 // PATCH, COLUMNS // PATCH)
SIDE_INPUTS = SIDE_PATCHES[0] * SIDE_PATCHES[1] // 4
SIDE_TOKENS = (PIXELS // 2 // TOKEN, PIXELS // TOKEN)


class MirrorLinear(nn.Module):
    """Linear layer (b, 2, ..., in) to (b, 2, ..., out) that commutes with swapping the two sides.

    Such a layer acts on the sum and on the difference of the sides apart: half the products of a
    full one.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.even = nn.Linear(inputs, outputs)
        self.odd = nn.Linear(inputs, outputs, bias=False)

    def forward(self, sides: Tensor) -> Tensor:
        """Map both sides."""
        # Swapping the sides leaves the sum and turns the sign of the difference. A layer that
        # commutes with it maps sums to sums and differences to differences (Schur's lemma), and
        # the odd part has no bias. 0.7, about 1 / sqrt(2), keeps the variance of sum and
        # difference.
        top, bottom = sides.unbind(1)
        even = self.even(0.7 * (top + bottom))
        odd = self.odd(0.7 * (top - bottom))
        return 0.7 * torch.stack([even + odd, even - odd], dim=1)


class Residual(nn.Module):
    """Residual block: layer norm, two layers with GELU between them, dropout; the last layer starts
    at zero.
    """

    def __init__(
        self,
        norm: int,
        layers: tuple[nn.Module, nn.Module],
        dropout: float,
        *,
        across: bool = False,
    ) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(norm)
        self.across = across
        self.first = layers[0]
        self.second = layers[1]
        self.dropout = nn.Dropout(dropout)

        # Each block starts as the identity, so that a deep trunk trains from the first step, and
        # blocks added to trained weights change nothing at first (`train_direct`).
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        """Map (b, 2, ..., n) to the same shape; `across` mixes over the axis before the last."""
        # Norm before the layers, not after (Xiong et al. 2020): the residual path stays linear,
        # and the rate needs little warm-up.
        y = self.norm(x)
        if self.across:
            y = y.transpose(-1, -2)
        y = self.dropout(self.second(functional.gelu(self.first(y))))
        if self.across:
            y = y.transpose(-1, -2)
        return x + y


class CellNormal(nn.Module):
    """Normalisation of each cell's depth and log intensity by median and spread over the training
    set, clipped.

    The frame's own gain is taken out of the intensity: the median ratio to the training set's
    medians over the quieter half of the cells, which hardly any object changes. In color there are
    three intensities, and one gain.
    """

    limit = CLIP
    median: Tensor
    spread: Tensor

    def __init__(self, *, color: bool = False) -> None:
        super().__init__()
        self.register_buffer("median", torch.zeros(channels_of(color=color), ROWS, COLUMNS))
        self.register_buffer("spread", torch.ones(channels_of(color=color), ROWS, COLUMNS))

    def learn(self, depth_m: Tensor, intensity: Tensor) -> None:
        """Set the statistics to those of maps (n, 64, 80), averaged with the mirrored ones."""
        for channel, values in enumerate(_channels(depth_m, intensity).unbind(1)):
            # Medians, since the objects in a part of the maps must not move the center of a cell
            # that sees bare wall in most of them.
            median = values.nanmedian(0).values.nan_to_num()
            spread = (values - median).square().nanmean(0).sqrt().nan_to_num()

            smallest = SMALLEST_SHARE * float(spread.median())
            if channel > 0:  # of light
                smallest = max(smallest, MIN_LIGHT_SPREAD)
            spread = spread.clamp(min=smallest)

            # Mirrored maps need the same normalisation, or the network is no longer symmetric.
            self.median[channel] = (median + median.flip(0)) / 2
            self.spread[channel] = (spread + spread.flip(0)) / 2

    def shift(self, depth_m: Tensor, intensity: Tensor, channels: slice = slice(None)) -> None:
        """Shift the medians of some or all channels as maps (n, 64, 80) of another bench ask for:
        its offset, its gain.

        One number a channel, the median over the cells: a few objects are too few for each
        cell's own median.
        """
        # Differences from the training rig's medians, and their median: an offset of the device
        # or a gain of the bench is common to all cells, an object is not.
        medians = _channels(depth_m, intensity).nanmedian(0).values
        shifts = (medians - self.median).flatten(1).nanmedian(1).values.nan_to_num()
        self.median[channels] += shifts[channels, None, None]

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Map maps (n, 64, 80) to (n, 2, 64, 80), in color (n, 4, 64, 80); a cell without a return
        is 0.
        """
        # (n, 2, 64, 80), in color (n, 4, 64, 80); log(1 + counts), so that a gain is an offset
        # and shot noise grows less with the light.
        off = _channels(depth_m, intensity) - self.median
        gain = self.log_gain(off[:, 1:].mean(1))[:, None, None, None]
        normal = torch.cat([off[:, :1], off[:, 1:] - gain], dim=1) / self.spread
        return torch.where(torch.isnan(normal), 0.0, normal.clamp(-CLIP, CLIP))

    def log_gain(self, light: Tensor) -> Tensor:
        """Return the logarithm of each frame's gain (n,), of log intensities (n, 64, 80) less the
        medians; 0 for none.

        Medians are taken by sorting, which every runtime can do, with cells that do not count at
        the end.
        """
        # A laser's power and a wall's reflectance scale all counts of a frame; without it taken
        # out, the network would read brightness as distance.
        some = light[..., ::GAIN_COLUMNS]
        spread = self.spread[1:, :, ::GAIN_COLUMNS].mean(0)
        # Cells whose light varies least over the training objects see the wall, not the object.
        quieter = spread <= spread.flatten().sort().values[(spread.numel() - 1) // 2]
        # ONNX has no median of a varying number of values: sorted with infinity in place of those
        # that do not count, the middle one is at (number - 1) // 2.
        counts = quieter & ~torch.isnan(some)
        ordered = torch.where(counts, some, torch.inf).flatten(1).sort(dim=1).values
        number = counts.flatten(1).sum(dim=1, keepdim=True)
        middle = ordered.gather(1, ((number - 1) // 2).clamp(min=0))
        return torch.where(number > 0, middle, 0.0)[:, 0]


def channels_of(*, color: bool) -> int:
    """Return the number of normalised channels: depth, and one intensity or three."""
    return 4 if color else 2


def _channels(depth_m: Tensor, intensity: Tensor) -> Tensor:
    """Stack depth and log(1 + intensity) to (n, 2 or 4, 64, 80), NaN where there is no return."""
    depth_m = depth_m[:, None]
    light = torch.log1p(intensity if intensity.dim() == 4 else intensity[:, None])
    return torch.cat([depth_m, torch.where(torch.isnan(depth_m), depth_m, light)], dim=1)


class DirectNetwork(nn.Module):
    """Network from maps (n, 64, 80) to images (n, 64, 64) in [0, 1] by two heads: is there a
    surface, and how deep.

    In color intensities are (n, 3, 64, 80), images (n, 3, 64, 64), and the second head draws three
    albedos.
    """

    def __init__(
        self, size: DirectSize | None = None, dropout: float = 0.0, *, color: bool = False
    ) -> None:
        super().__init__()
        self.size = size = size or DirectSize()
        self.normal = CellNormal(color=color)
        within = size.features // 2
        channels = channels_of(color=color)
        self.patch = nn.Linear(channels * PATCH**2, within)
        self.merge = nn.Linear(4 * within, size.features)
        self.into = MirrorLinear(SIDE_INPUTS * size.features, size.width)
        blocks = list[nn.Module]()
        for _ in range(size.blocks):
            over_sides = (
                MirrorLinear(size.width, 2 * size.width),
                MirrorLinear(2 * size.width, size.width),
            )
            blocks.append(Residual(size.width, over_sides, dropout))
        self.trunk = nn.Sequential(*blocks)
        tokens = SIDE_TOKENS[0] * SIDE_TOKENS[1]
        self.out = MirrorLinear(size.width, tokens * size.token)
        self.place = nn.Parameter(0.02 * torch.randn(tokens, size.token))
        mixers = list[nn.Module]()
        for _ in range(size.mixers):
            over_tokens = MirrorLinear(tokens, 2 * tokens), MirrorLinear(2 * tokens, tokens)
            over_features = (
                nn.Linear(size.token, 2 * size.token),
                nn.Linear(2 * size.token, size.token),
            )
            mixers += [
                Residual(size.token, over_tokens, 0.0, across=True),
                Residual(size.token, over_features, 0.0),
            ]
        self.mixers = nn.Sequential(*mixers)
        self.norm = nn.LayerNorm(size.token)
        self.heads = nn.Linear(size.token, channels * TOKEN**2)

    def logits(self, normal: Tensor) -> Tensor:
        """Map normalised maps (n, 2, 64, 80) to two logits (n, 2, 64, 64): of a surface, and of its
        v in [0.1, 1].

        In color four channels become four logits.
        """
        return self.decode(self.encode(normal), normal.shape[1])

    def encode(self, normal: Tensor) -> Tensor:
        """Map normalised maps (n, 2 or 4, 64, 80) to features of both sides (n, 2, width)."""
        # The bottom half upside down: row k of either side is as far from the plane of symmetry.
        sides = torch.stack(
            [normal[..., : ROWS // 2, :], normal[..., ROWS // 2 :, :].flip(-2)], dim=1
        )
        x = functional.gelu(self.patch(_patches(sides, PATCH)))  # (n, 2, 8, 20, within)
        x = functional.gelu(self.merge(_patches(x.movedim(-1, 2), 2)))  # (n, 2, 4, 10, features)
        return self.into(x.flatten(2))

    def decode(self, features: Tensor, channels: int) -> Tensor:
        """Map features of both sides (n, 2, width) to logits (n, 2 or 4, 64, 64)."""
        x = self.trunk(features)
        x = self.out(x).unflatten(-1, self.place.shape) + self.place
        x = self.heads(self.norm(self.mixers(x)))  # (n, 2, 32, 128)
        x = x.unflatten(-1, (channels, TOKEN, TOKEN)).unflatten(
            2, SIDE_TOKENS
        )  # (n, side, row, column, head, y, x)
        # Tokens back to pixels: (n, side, head, row, y, column, x), then the bottom side turned
        # up.
        x = x.permute(0, 1, 4, 2, 5, 3, 6).reshape(-1, 2, channels, PIXELS // 2, PIXELS)
        return torch.cat([x[:, 0], x[:, 1].flip(-2)], dim=-2)

    @property
    def intensities(self) -> int:
        """Number of intensities of the maps: one, three in color."""
        return len(self.normal.median) - 1

    @property
    def last_layers(self) -> list[nn.Module]:
        """Layers that the second phase of a transfer trains."""
        return [self.norm, self.heads]

    def forward(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Return the images of maps (n, 64, 80) with NaN depth where there is no return."""
        return self.answer(depth_m, intensity)[0]

    def answer(self, depth_m: Tensor, intensity: Tensor) -> tuple[Tensor, Tensor]:
        """Return the images of maps, and the probability (n, 64, 64) that there is a surface."""
        logits = self.logits(self.normal(depth_m, intensity))
        return image_from_logits(logits), torch.sigmoid(logits[:, 0].float())


def _patches(x: Tensor, side: int) -> Tensor:
    """Cut (n, 2, channels, rows, columns) into patches: (n, 2, rows / side, columns / side,
    channels * side**2).
    """
    x = x.unflatten(-1, (-1, side)).unflatten(3, (-1, side))  # (n, 2, c, row, y, column, x)
    return x.permute(0, 1, 3, 5, 2, 4, 6).flatten(4)


def image_from_logits(logits: Tensor) -> Tensor:
    """Return images (n, 64, 64) of logits (n, 2, 64, 64), each cut where its silhouette's expected
    overlap is largest.

    Four logits, in color, make images (n, 3, 64, 64).
    """
    # A cut at 0.5 is best for single pixels, not for the overlap: a small object of probability
    # 0.4 throughout would vanish. With p the probability of a surface, the expected intersection
    # over union is about (sum of p inside) / (area + sum of p outside). It is computed at six cuts
    # and the best is taken; sum of p outside = sum of all p - sum of p inside.
    every = torch.sigmoid(logits.float())
    share = every[:, 0]
    values = every[:, 1:] if every.shape[1] > 2 else every[:, 1]
    cuts = share.new_tensor(CUTS)
    above = share[:, None] > cuts[:, None, None]
    inside = (share[:, None] * above).sum((2, 3))
    area = above.sum((2, 3))
    overlap = inside / (share.sum((1, 2))[:, None] + area - inside)
    surface = share > cuts[overlap.argmax(1)][:, None, None]
    return torch.where(
        surface if values.dim() == 3 else surface[:, None], MIN_V + (1 - MIN_V) * values, 0.0
    )
