"""The silhouette cut: what it keeps, and that it is a projection."""

import pytest
import torch
from nlos_models.metrics import LEAST_V
from nlos_models.pipeline import KEPT_SHARE, WINDOW, cut_silhouette, lift_edges


def _blurred() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(4, 1, 64, 64, generator=generator)
    return torch.nn.functional.avg_pool2d(noise, 9, stride=1, padding=4) * 1.5


def test_a_pixel_is_kept_as_it_is_or_becomes_background() -> None:
    image = _blurred()
    cut = cut_silhouette(image)
    assert ((cut == image) | (cut == 0)).all()


def test_what_is_kept_is_a_possible_hidden_image() -> None:
    cut = cut_silhouette(_blurred())
    assert ((cut == 0) | (cut >= LEAST_V)).all()


def test_a_flat_surface_stays_whole() -> None:
    image = torch.zeros(1, 1, 64, 64)
    image[..., 10:40, 20:50] = 0.3
    assert torch.equal(cut_silhouette(image), image)


def test_a_faint_skirt_beside_a_bright_surface_goes_and_the_same_value_far_away_stays() -> None:
    image = torch.zeros(1, 1, 64, 64)
    image[..., 10:30, 10:20] = 0.9
    faint = 0.9 * KEPT_SHARE * 0.9
    image[..., 10:30, 20:23] = faint
    image[..., 50:60, 50:60] = faint
    cut = cut_silhouette(image)
    assert (cut[..., 20:23] == 0).all()
    assert (cut[..., 50:60, 50:60] == faint).all()
    assert WINDOW < 30


@pytest.mark.parametrize("value", [0.0, 0.05, LEAST_V, 1.0])
def test_constant_images(value: float) -> None:
    image = torch.full((1, 1, 64, 64), value)
    assert torch.equal(cut_silhouette(image), image if value >= LEAST_V else torch.zeros_like(image))


def test_brightest_pixels_are_never_cut() -> None:
    image = _blurred()
    peak = image.flatten(1).argmax(1)
    assert (cut_silhouette(image).flatten(1).gather(1, peak[:, None]) > 0).all()


def test_lifting_only_brightens_and_stays_within_the_images_own_values() -> None:
    image = _blurred()
    lifted = lift_edges(image)
    assert (lifted >= image).all()
    assert (lifted <= image.amax((2, 3), keepdim=True) + 1e-6).all()


def test_a_plateau_and_a_blurred_edge_of_it_come_out_level() -> None:
    image = torch.zeros(1, 1, 64, 64)
    image[..., 10:40, 20:50] = 0.8
    image[..., 10:40, 50:52] = 0.5
    lifted = lift_edges(image)
    torch.testing.assert_close(lifted[..., 10:40, 20:48], image[..., 10:40, 20:48])
    assert (lifted[..., 15:35, 50:52] > 0.7).all()


def test_of_colours_the_brightest_channel_tells_for_all() -> None:
    image = torch.zeros(1, 3, 64, 64)
    image[0, :, 10:40, 10:40] = torch.tensor([0.9, 0.02, 0.5])[:, None, None]
    image[0, :, 10:40, 40:43] = torch.tensor([0.3, 0.35, 0.3])[:, None, None]
    cut = cut_silhouette(image)
    assert torch.equal(cut[..., 10:40, 10:40], image[..., 10:40, 10:40])
    assert (cut[..., 40:43] == 0).all()
    turned = cut_silhouette(image[:, [1, 2, 0]])
    assert torch.equal(turned, cut[:, [1, 2, 0]])
