"""Uncertainty network: maps and the image reconstructed from them in, expected error and
verdicts out.

Our own, not the paper's; about 200,000 parameters. Its inputs are the maps' differences from the
bare wall's, at a coarse and at a fine scale, and the image; the two branches meet at 8 x 8.
"""

import json
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from nlos_cam.files import write_checked
from nlos_models import records
from nlos_models.checkpoint import load_part, save_parts
from nlos_models.compressor import conv_norm
from nlos_models.errors import CheckpointError
from nlos_models.inference import MAP_SHAPE

DEPTH_SCALES_M = (0.1, 0.005)
INTENSITY_SCALES = (10.0, 1.0)
"""Scales of the differences from the bare wall: coarse for the hidden object, fine for the question
if there is one.
"""
MIN_ERROR_V = 1e-3
MAX_ERROR_V = 1.0
"""Range of an expected error."""


class UncertaintyOutput(NamedTuple):
    """Raw outputs for training: logits, and the logarithm of a scale."""

    nothing: Tensor
    """(n,): logit that nothing is hidden."""
    outside: Tensor
    """(n,): logit that the sample is out of distribution."""
    log_error: Tensor
    """(n, 64, 64): logarithm of the expected absolute error in v, given a surface."""
    surface: Tensor
    """(n, 64, 64): logit that there is a surface."""


def _down(channels_in: int, channels_out: int, stride: int = 2) -> nn.Sequential:
    return nn.Sequential(*conv_norm(channels_in, channels_out, 3, stride), nn.ReLU())


class _Up(nn.Module):
    """Upsampling block: narrow, double the size, join with the features of that size on the way
    down.
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(channels_in, channels_out, 1)
        self.join = _down(2 * channels_out, channels_out, stride=1)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        wide = functional.interpolate(self.narrow(coarse), scale_factor=2.0)
        return self.join(torch.cat([wide, fine], 1))


class UncertaintyNetwork(nn.Module):
    """Uncertainty network of maps (n, 64, 80) and images (n, 64, 64)."""

    bare_depth_m: Tensor
    bare_intensity: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("bare_depth_m", torch.zeros(MAP_SHAPE))
        self.register_buffer("bare_intensity", torch.zeros(MAP_SHAPE))
        # 64 x 80 -> 8 x 10 in three halvings; with a fourth block at that size, each feature sees
        # 31 x 31 cells.
        self.maps = nn.Sequential(
            _down(5, 16), _down(16, 32), _down(32, 64), _down(64, 64, stride=1)
        )
        self.image = nn.ModuleList([_down(1, 16), _down(16, 32), _down(32, 64)])
        self.meet = _down(128, 64, stride=1)
        self.ups = nn.ModuleList([_Up(64, 32), _Up(32, 16)])
        self.pixels = nn.Conv2d(17, 2, 3, padding=1)
        self.frame = nn.Sequential(nn.Linear(256, 64), nn.ReLU(), nn.Dropout(0.2), nn.Linear(64, 2))

    def learn_bare(self, depth_m: Tensor, intensity: Tensor) -> None:
        """Set the bare wall to each cell's median over maps (n, 64, 80) of benches with nothing
        hidden.
        """
        # The median: a cell with a few wrong returns has the right value, a mean has not. On the
        # wall grid each bench sees other cells: those without a return have no light either.
        light = torch.where(torch.isnan(depth_m), torch.nan, intensity)
        self.bare_depth_m.copy_(torch.nan_to_num(depth_m.nanmedian(0).values))
        self.bare_intensity.copy_(torch.nan_to_num(light.nanmedian(0).values))

    def features(self, depth_m: Tensor, intensity: Tensor) -> Tensor:
        """Return (n, 5, 64, 80): differences from the bare wall, each from -1 to 1, and 1 for cells
        without return.
        """
        # Two scales of each difference, since tanh saturates: an object moves some cells by
        # centimetres and counts by tens, while the question whether there is anything is one of
        # millimetres. tanh bounds what a strange frame can do to the network.
        invalid = torch.isnan(depth_m)
        farther_m = torch.where(invalid, 0.0, depth_m - self.bare_depth_m)
        brighter = torch.where(invalid, 0.0, intensity - self.bare_intensity)
        features = [torch.tanh(farther_m / scale) for scale in DEPTH_SCALES_M]
        features += [torch.tanh(brighter / scale) for scale in INTENSITY_SCALES]
        return torch.stack([*features, invalid.to(depth_m.dtype)], 1)

    def forward(self, depth_m: Tensor, intensity: Tensor, image: Tensor) -> UncertaintyOutput:
        """Return the raw outputs for maps (n, 64, 80) with NaN for no return and images (n, 64, 64)
        in [0, 1].
        """
        from_maps = self.maps(self.features(depth_m, intensity))
        levels = [image[:, None]]
        for down in self.image:
            levels.append(down(levels[-1]))
        # The maps say what is there, the image what was made of it: an error is a disagreement of
        # both. They meet at 8 x 8, where each feature covers an object's part.
        joint = self.meet(
            torch.cat([functional.interpolate(from_maps, (8, 8), mode="bilinear"), levels[3]], 1)
        )
        fine = self.ups[1](self.ups[0](joint, levels[2]), levels[1])
        pixels = self.pixels(
            torch.cat([functional.interpolate(fine, scale_factor=2.0), levels[0]], 1)
        )
        # Means for what is everywhere (empty benches, noise), largest values for what is in one
        # place (a strange part).
        pooled = [part for x in (from_maps, joint) for part in (x.mean((2, 3)), x.amax((2, 3)))]
        logits = self.frame(torch.cat(pooled, 1))
        # An untrained error starts at exp(-3) = 0.05 of the depth range, the size of real ones:
        # from 1 the first steps would only lower it.
        return UncertaintyOutput(logits[:, 0], logits[:, 1], pixels[:, 0] - 3.0, pixels[:, 1])


class CalibratedUncertainty(nn.Module):
    """Uncertainty network with its calibration: probabilities, and an expected error in v."""

    temperature: Tensor
    error_scale: Tensor

    def __init__(
        self, network: UncertaintyNetwork, temperatures: tuple[float, float], error_scale: float
    ) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("temperature", torch.tensor(temperatures))
        self.register_buffer("error_scale", torch.tensor(error_scale))

    def forward(
        self, depth_m: Tensor, intensity: Tensor, image: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the four arrays of `inference.UncertaintyEstimate`."""
        raw = self.network(depth_m, intensity, image)
        nothing = raw.nothing / self.temperature[0]
        outside = raw.outside / self.temperature[1]
        # Network and calibration are one module, so that the exported graph answers with
        # probabilities.
        error_v = (self.error_scale * raw.log_error.exp()).clamp(MIN_ERROR_V, MAX_ERROR_V)
        return torch.sigmoid(nothing), torch.sigmoid(outside), error_v, torch.sigmoid(raw.surface)


def save_uncertainty_network(
    folder: Path, network: UncertaintyNetwork, record: records.UncertaintyRecord, watched: Path
) -> None:
    """Write an uncertainty network and its record into a folder, with a copy of the watched weights
    from elsewhere.
    """
    if records.checksum_of_watched(watched) != record.watches:
        raise CheckpointError(
            f"{watched} changed during the training of its uncertainty network: train again"
        )
    text = json.dumps(record.model_dump(mode="json"), indent=2)
    # The copies first: with the record of the uncertainty network the folder is whole.
    if folder.resolve() != watched.resolve():
        names = (*records.watched_files(watched), records.RECORD)
        write_checked(folder, {name: (watched / name).read_bytes() for name in names})
    save_parts(folder, {records.UNCERTAINTY: network}, {records.UNCERTAINTY_RECORD: text})


def load_uncertainty_network(
    folder: Path,
) -> tuple[CalibratedUncertainty, records.UncertaintyRecord] | None:
    """Return the calibrated uncertainty network beside a pipeline's weights in eval mode, or None
    where there is none.

    Raises CheckpointError where it cannot be read or watches other weights.
    """
    if (record := records.load_uncertainty_record(folder)) is None:
        return None
    network = UncertaintyNetwork()
    load_part(folder / f"{records.UNCERTAINTY}.safetensors", network)
    return CalibratedUncertainty(network, record.temperatures, record.error_scale).eval(), record
