import importlib
import sys
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from fake_bench import Bench
from hypothesis import settings
from measured_walls import exact_reference
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.noise import depth_noise_m
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import fit_wall, wall_depth
from nlos_calibration.wall_record import MeasuredWall, new_wall_record
from nlos_models import compressor, vae
from rewritten_bags import Edit, rewrite

settings.register_profile("no clock", deadline=None)  # a machine that is busy fails no law
settings.load_profile("no clock")

TOOLS = Path(__file__).parents[2] / "tools"
DATA = "data/realsense_d435_depth_color_640x480.bag"


@pytest.fixture(scope="session")
def tool() -> Iterator[Callable[[str], ModuleType]]:
    """A module of the tools folder, by name."""
    sys.path.insert(0, str(TOOLS))
    yield importlib.import_module
    sys.path.remove(str(TOOLS))


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """An L515 on a healthy host."""
    return Bench(tmp_path)


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Of torch: small networks are slower on several, and sums come out in the same order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def real_bag() -> Path:
    """A D435's recording of 2018, in a data folder of the checkout or beside it."""
    root = Path(__file__).parents[2]
    found = [root / DATA, *sorted(root.parent.glob(f"*/{DATA}"))]
    if path := next((path for path in found if path.is_file()), None):
        return path
    pytest.skip(f"no {DATA} in this checkout, or in a folder beside it")


@pytest.fixture
def rewritten(noise_bag: Path, tmp_path: Path) -> Callable[..., Path]:
    def make(edit: Edit, *, source: Path = noise_bag, compression: str | None = None) -> Path:
        return rewrite(source, tmp_path / "rewritten.bag", edit, compression)

    return make


@pytest.fixture(scope="session")
def noise_bag_uncompressed(noise_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same frames, where no checksum guards them."""
    target = tmp_path_factory.mktemp("bags") / "uncompressed.bag"
    return rewrite(noise_bag, target, lambda _, time_ns, raw: [(time_ns, raw)])


def fitted_wall(
    distance_m: float = 0.2,
    yaw_deg: float = 40.0,
    pitch_deg: float = 3.0,
    *,
    width: int = 64,
    **others: Any,
) -> MeasuredWall:
    """A wall as it is measured without noise, by 60 frames of an even light; `others` are fields of
    its record.
    """
    pinhole = load_rig("paper-rig").pinhole.scaled(width, 3 * width // 4)
    pose = wall_from_plane(
        normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)), distance_m
    )
    depth_m = wall_depth(pose, pinhole)
    depth_m[depth_m > 9.0] = np.nan
    fit = fit_wall(depth_m, pinhole, np.random.default_rng(0))
    seen = {
        "depth_m": depth_m.astype(np.float32),
        "depth_std_m": depth_noise_m(depth_m).astype(np.float32),
    }
    seen |= {
        "ir": np.full(depth_m.shape, 48, np.float32),
        "inliers": np.isfinite(depth_m),
        "frames": 60,
    }
    fields = {"noise_scale": 1.0, **others}
    record = new_wall_record(
        fit, pinhole, camera="l515:f0246262", frames=60, created=date(2026, 1, 31), others=fields
    )
    return MeasuredWall(record, exact_reference(pose, pinhole, seen))


@pytest.fixture(scope="session")
def measured() -> Callable[..., MeasuredWall]:
    return fitted_wall


@pytest.fixture(scope="module")
def narrow_networks() -> Iterator[None]:
    """Res-VAE and ResNet50 with a sixteenth of their channels: all that their widths decide is
    time.
    """
    with pytest.MonkeyPatch.context() as patch:
        (into, within, out), *rest = vae.UP_BLOCKS
        narrow = [
            (into, within // 16, out // 16),
            *(tuple(width // 16 for width in block) for block in rest),
        ]
        patch.setattr(vae, "UP_BLOCKS", tuple(narrow))
        stages = tuple((within // 16, *others) for within, *others in compressor.COLOR_STAGES)
        patch.setattr(compressor, "COLOR_STAGES", stages)
        yield
