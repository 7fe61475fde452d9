"""What the fakes of doubt promise."""

from pathlib import Path

import numpy as np
from nlos_models.doubt_checkpoint import load_doubt
from small_doubt import small_doubt_set, untrained_doubt, watched_weights


def test_a_set_has_all_three_sorts_and_errors_that_depend_on_the_image() -> None:
    some = small_doubt_set(40, 0)
    assert (some.nothing.sum(), some.outside.sum()) == (20, 10)
    assert not (some.nothing & some.outside).any()
    assert not some.truth[some.nothing].any()
    off = np.abs(some.made.astype(float) - some.truth)
    dark, bright = (off[(some.truth > 0) & (some.truth.astype(float) < 0.5)], off[some.truth.astype(float) > 0.5])
    assert dark.min() > 5 * bright.max() > 0


def test_an_untrained_network_can_be_loaded_and_every_seed_gives_another(tmp_path: Path) -> None:
    watched = watched_weights(tmp_path / "watched")
    for seed in (0, 1):
        untrained_doubt(tmp_path / str(seed), watched, seed)
    one, other = (load_doubt(tmp_path / str(seed)) for seed in (0, 1))
    assert one is not None
    assert other is not None
    assert not np.array_equal(one[0].network.pixels.weight.detach(), other[0].network.pixels.weight.detach())
