"""Errors of the models package, and of a missing extra "train", whose libraries the base
installation leaves out.

    ModelError (ValueError)               exit 1   root
    ├── MissingExtraError (ImportError)   exit 1   'training needs torch: pip install ...'
    ├── TrainingError                     exit 1   "the loss is nan in epoch 3: choose ..."
    ├── CheckpointError                   exit 4   "decoder.safetensors cannot be read as ..."
    └── RecipeError                       exit 4   "recipe.toml: batch: must be greater than 1 ..."
        └── UnknownRecipeError            exit 2   "no recipe 'vea'. Did you mean 'vae'?"

Outputs that exist or are being written raise OutputExistsError and FileBusyError of `nlos_cam`.
"""

import re
from importlib import import_module
from typing import Any

OUT_OF_MEMORY = "failed to map", "bad_alloc", "allocate memory"
"""Words of the errors of libraries that do not fit into the memory that is left, or of their
work.
"""


def lacks_memory(error: BaseException) -> bool:
    """Return whether an error or its cause says that memory is short: Python's own, or one of a
    library in C++.
    """
    if isinstance(error, MemoryError) or any(words in str(error) for words in OUT_OF_MEMORY):
        return True
    return error.__cause__ is not None and lacks_memory(error.__cause__)


class ModelError(ValueError):
    """Root of the errors that this package raises on purpose."""

    exit_code = 1


class TrainingError(ModelError):
    """A training run that cannot continue; its saved state stays."""


class CheckpointError(ModelError):
    """Weights that cannot be read or do not fit the model."""

    exit_code = 4


class RecipeError(ModelError):
    """A training recipe that cannot be read or contradicts itself."""

    exit_code = 4


class UnknownRecipeError(RecipeError):
    """A mistyped name of a packaged recipe."""

    exit_code = 2


WORDING = {
    "^Value error, |^Assertion failed, ": "",
    "^Field required$": "is missing",
    "^Extra inputs are not permitted$": "is no known field",
    "^Input should be ": "must be ",
    "a valid integer.*": "a whole number",
    "a valid (number|string|boolean|list|dictionary).*": r"a \1",
}
"""Phrases of pydantic as patterns, and how a person says them."""


def first_problem(error: Any) -> str:
    """Return the first problem of pydantic's ValidationError as one line: field, problem, value."""
    problem = error.errors()[0]
    field = ".".join(map(str, problem["loc"]))
    text = problem["msg"]
    value = problem["input"]
    for library, plain in WORDING.items():
        text = re.sub(library, plain, text)
    if isinstance(value, dict):  # a rule among fields: the values of those that its message names
        given = {
            name: got
            for name, got in value.items()
            if re.search(rf"\b{re.escape(str(name))}\b", text)
        }
        got = ", ".join(
            f"{name} = {got!r:.40}" for name, got in given.items() if str(got) not in text
        )
    else:
        got = "" if isinstance(value, list) or not field else f"{value!r:.80}"
    text += f" (got {got})" if got else ""
    return f"{field}: {text}" if field else text


TRAIN = frozenset({"h5py", "lightning_fabric", "onnx", "onnxscript", "tensorboard", "torch"})
"""Top-level modules of the extra "train"."""


class MissingExtraError(ModelError, ImportError):
    """Library of an extra that is not installed: 'training needs torch: pip install
    "nlos-cam[train]"'.
    """


def require(module: str, purpose: str) -> Any:
    """Return a module; `purpose` is the subject of the message if it, or an import in it, is
    missing from the extra.

    Raises MissingExtraError with the command that installs the extra.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if missing := missing_extra(error, purpose):
            raise missing from error
        raise


def missing_extra(
    error: ModuleNotFoundError, purpose: str = "this command"
) -> MissingExtraError | None:
    """Return a failed import as the error of a missing extra; None for other modules."""
    name = (error.name or "").partition(".")[0]
    if name not in TRAIN:
        return None
    return MissingExtraError(
        f'{purpose} needs {name}, which is not installed: pip install "nlos-cam[train]", in a clone'
        " pip install -e '.[train]'; without a GPU, first pip install torch --index-url"
        " https://download.pytorch.org/whl/cpu, which is several GB smaller"
    )
