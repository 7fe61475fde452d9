"""Errors of the models package.

ModelError (ValueError)                  exit 1   root
├── TrainingError                        exit 1   "the loss is nan in epoch 3: choose a smaller learning_rate"
├── OutputExistsError (FileExistsError)  exit 1   "runs/a holds weights from another run: choose another --out"
├── CheckpointError                      exit 4   "decoder.safetensors cannot be read as weights: ..."
└── RecipeError                          exit 4   "recipe.toml: batch: Input should be greater than 1 (got 1)"
"""


class ModelError(ValueError):
    """Root of the errors that this package raises on purpose."""

    exit_code = 1


class TrainingError(ModelError):
    """A training run that cannot continue; its saved state stays."""


class OutputExistsError(ModelError, FileExistsError):
    """An output folder with other contents, which training would overwrite."""


class CheckpointError(ModelError):
    """Weights that cannot be read or do not fit the model."""

    exit_code = 4


class RecipeError(ModelError):
    """A training recipe that cannot be read or contradicts itself."""

    exit_code = 4
