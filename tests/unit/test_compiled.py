"""torch.compile: the same figures within rounding, noise and dropout too; where it cannot work, one line."""

import shutil
from collections.abc import Iterator

import pytest
import torch
from nlos_models.errors import TrainingError
from nlos_models.train import compiled, compiling
from torch import Tensor, nn
from torch._inductor import config
from torch._inductor.exc import InductorError

pytestmark = pytest.mark.usefixtures("one_thread")

needs_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in config.cpp.cxx if name), reason="torch.compile needs a C++ compiler here"
)


@pytest.fixture(autouse=True)
def _nothing_compiled() -> Iterator[None]:
    torch.compiler.reset()
    with config.patch(compile_threads=1):  # else torch keeps some for later
        yield
    torch.compiler.reset()


class Noisy(nn.Module):
    """A linear map with dropout and noise of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.linear, self.dropout = nn.Linear(3, 2), nn.Dropout(0.5)

    def noisy(self, x: Tensor) -> Tensor:
        """A part of a network, as a compressor's latent is of a pipeline."""
        return self.dropout(self.linear(x + 0.2 * torch.randn_like(x)))


@needs_compiler
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_a_compiled_part_makes_the_loss_and_the_gradients_of_the_plain_one_noise_and_dropout_too() -> None:
    network, x, found = Noisy(), torch.rand(8, 3), []
    for part in (network.noisy, compiled(network.noisy)):
        network.zero_grad()
        torch.manual_seed(5)
        loss = part(x).square().sum()
        loss.backward()
        found.append((loss.detach(), network.linear.weight.grad.clone()))
    torch.testing.assert_close(*found)


def test_a_network_that_cannot_be_compiled_is_one_line() -> None:
    network = torch.compile(nn.Linear(3, 2), backend=_no_compiler)
    with (
        pytest.raises(TrainingError, match=r"--compile does not work here \(No g\+\+\): install a C") as caught,
        compiling(),
    ):
        network(torch.rand(1, 3))
    assert "\n" not in str(caught.value)


def _no_compiler(*_: object) -> None:
    raise RuntimeError("No g++\nand a page of other words")


def test_gradients_that_cannot_be_compiled_are_one_line() -> None:
    error = InductorError(RuntimeError("No g++\nand more"), None)
    with pytest.raises(TrainingError, match=r"does not work here \(.*No g\+\+\)"), compiling():
        raise error


def test_what_a_network_itself_raises_is_not_blamed_on_the_compiler() -> None:
    with pytest.raises(RuntimeError, match="shapes cannot be multiplied"), compiling():
        nn.Linear(3, 2)(torch.rand(1, 4))
