"""Weights on a tool's command line, DIR or NAME=DIR, and errors about them as one line."""

from argparse import ArgumentTypeError
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError

from nlos_cam.errors import NlosCamError

Named = tuple[str, Path]


def named(text: str) -> Named:
    """A folder of weights and what it is called, as an argument's `type`."""
    name, equals, folder = text.partition("=")
    path = Path(folder if equals else text)
    if not (path / "checkpoint.json").is_file():
        raise ArgumentTypeError(f"no weights in {path}: name a folder that `nlos-cam train` wrote")
    return name if equals else path.resolve().name, path


def by_name(weights: Sequence[Named]) -> dict[str, Path]:
    """Folders by their names. Ends the program where two have the same."""
    names = [name for name, _ in weights]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SystemExit(f"two weights are called {twice[0]!r}: tell them apart by NAME=DIR")
    return dict(weights)


@contextmanager
def errors_told() -> Generator[None]:
    """An error that was foreseen ends the program with one line."""
    try:
        yield
    except (NlosCamError, CalibrationError, ModelError) as error:
        raise SystemExit(f"error: {error}") from error
