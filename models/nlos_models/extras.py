"""Libraries of the extra "train", which the base installation leaves out."""

from importlib import import_module
from typing import Any

from nlos_models.errors import ModelError

TRAIN = frozenset({"h5py", "lightning_fabric", "onnx", "onnxscript", "tensorboard", "torch"})
"""Top-level modules of the extra "train"."""


class MissingExtraError(ModelError, ImportError):
    """Library of an extra that is not installed: 'training needs torch: pip install "nlos-cam[train]"'."""


def require(module: str, purpose: str) -> Any:
    """Return a module; `purpose` is the subject of the message if it, or an import in it, is missing from the extra.

    Raises MissingExtraError with the command that installs the extra.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if missing := missing_extra(error, purpose):
            raise missing from error
        raise


def missing_extra(error: ModuleNotFoundError, purpose: str = "this command") -> MissingExtraError | None:
    """Return a failed import as the error of a missing extra; None for other modules."""
    name = (error.name or "").partition(".")[0]
    if name not in TRAIN:
        return None
    return MissingExtraError(f'{purpose} needs {name}, which is not installed: pip install "nlos-cam[train]"')
