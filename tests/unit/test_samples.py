import pytest

from nlos_cam.live.replay_media import Samples


@pytest.mark.parametrize("count", [1, 5, 6, 7, 100, 1001])
def test_samples_are_few_ordered_and_spread(count: int) -> None:
    samples = Samples(6)
    for number in range(count):
        samples.add(number)  # type: ignore[arg-type]
    chosen = samples.chosen()
    assert len(chosen) == min(count, 6)
    assert chosen[0] == 0
    assert chosen == sorted(set(chosen))
    assert chosen[-1] >= 0.7 * (count - 1)
