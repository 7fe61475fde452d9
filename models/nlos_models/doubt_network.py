"""The doubt network: maps and what was made of them in; how far that may be believed out (about 200,000 parameters).

Our own, not the paper's. It sees where the maps leave the bare wall's, which it has learnt, coarsely and finely, and
the image that the networks that it watches made; the two meet at 8 x 8.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from nlos_models.compressor import conv_norm

MAP_SHAPE = (64, 80)
DEPTH_SCALES_M = (0.1, 0.005)
INTENSITY_SCALES = (10.0, 1.0)
"""By which what differs from the bare wall is told: coarsely, for what is hidden, and finely, for whether it is."""
MIN_ERROR_V, MAX_ERROR_V = 1e-3, 1.0
"""Between which an expected error lies."""


class DoubtOutput(NamedTuple):
    """What the network says, as it is trained: logits, and the logarithm of a scale."""

    nothing: Tensor
    """(n,)."""
    outside: Tensor
    """(n,)."""
    log_error: Tensor
    """(n, 64, 64); of the expected absolute error in v, were there a surface."""
    surface: Tensor
    """(n, 64, 64); that there is a surface."""


def _down(channels_in: int, channels_out: int, stride: int = 2) -> nn.Sequential:
    return nn.Sequential(*conv_norm(channels_in, channels_out, 3, stride), nn.ReLU())


class _Up(nn.Module):
    """Narrow, double the size, join with what was there on the way down."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(channels_in, channels_out, 1)
        self.join = _down(2 * channels_out, channels_out, stride=1)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        wide = functional.interpolate(self.narrow(coarse), scale_factor=2.0)
        return self.join(torch.cat([wide, fine], 1))


class DoubtNetwork(nn.Module):
    """Maps (n, 64, 80) and images (n, 64, 64) to doubt."""

    bare_depth_m: Tensor
    bare_intensity: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("bare_depth_m", torch.zeros(MAP_SHAPE))
        self.register_buffer("bare_intensity", torch.zeros(MAP_SHAPE))
        self.maps = nn.Sequential(_down(5, 16), _down(16, 32), _down(32, 64), _down(64, 64, stride=1))
        self.image = nn.ModuleList([_down(1, 16), _down(16, 32), _down(32, 64)])
        self.meet = _down(128, 64, stride=1)
        self.ups = nn.ModuleList([_Up(64, 32), _Up(32, 16)])
        self.pixels = nn.Conv2d(17, 2, 3, padding=1)
        self.frame = nn.Sequential(nn.Linear(256, 64), nn.ReLU(), nn.Dropout(0.2), nn.Linear(64, 2))

    def learn_bare(self, depth_m: Tensor, intensity: Tensor) -> None:
        """Take the bare wall from maps (n, 64, 80) of benches with nothing hidden: each cell's median."""
        self.bare_depth_m.copy_(torch.nan_to_num(depth_m.nanmedian(0).values))
        self.bare_intensity.copy_(intensity.median(0).values)

    def features(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Where maps leave the bare wall's (n, 5, 64, 80), each from -1 to 1, and which cells have no return."""
        gone = torch.isnan(depth_m)
        beyond_m = torch.where(gone, 0.0, depth_m - self.bare_depth_m)
        brighter = torch.where(gone, 0.0, intensity - self.bare_intensity)
        told = [torch.tanh(beyond_m / scale) for scale in DEPTH_SCALES_M]
        told += [torch.tanh(brighter / scale) for scale in INTENSITY_SCALES]
        return torch.stack([*told, gone.to(depth_m.dtype)], 1)

    def forward(self, depth_m: Tensor, intensity: Tensor, image: Tensor) -> DoubtOutput:
        """Maps (n, 64, 80), NaN depth where there is no return, and images (n, 64, 64) in [0, 1]."""
        seen = self.maps(self.features(depth_m, intensity))
        levels = [image[:, None]]
        for down in self.image:
            levels.append(down(levels[-1]))
        met = self.meet(torch.cat([functional.interpolate(seen, (8, 8), mode="bilinear"), levels[3]], 1))
        fine = self.ups[1](self.ups[0](met, levels[2]), levels[1])
        both = self.pixels(torch.cat([functional.interpolate(fine, scale_factor=2.0), levels[0]], 1))
        pooled = [part for of in (seen, met) for part in (of.mean((2, 3)), of.amax((2, 3)))]
        logits = self.frame(torch.cat(pooled, 1))
        return DoubtOutput(logits[:, 0], logits[:, 1], both[:, 0] - 3.0, both[:, 1])


class Told(nn.Module):
    """The network as it is used: probabilities and an expected error, calibrated."""

    temperature: Tensor
    error_scale: Tensor

    def __init__(self, network: DoubtNetwork, temperatures: tuple[float, float], error_scale: float) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("temperature", torch.tensor(temperatures))
        self.register_buffer("error_scale", torch.tensor(error_scale))

    def forward(self, depth_m: Tensor, intensity: Tensor, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Probabilities of nothing and of outside (n,); expected error in v, probability of surface (n, 64, 64)."""
        said = self.network(depth_m, intensity, image)
        nothing, outside = said.nothing / self.temperature[0], said.outside / self.temperature[1]
        error_v = (self.error_scale * said.log_error.exp()).clamp(MIN_ERROR_V, MAX_ERROR_V)
        return torch.sigmoid(nothing), torch.sigmoid(outside), error_v, torch.sigmoid(said.surface)
