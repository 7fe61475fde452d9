"""Errors of the models package.

ModelError (ValueError)          exit 1   root
├── TrainingError                exit 1   a run that cannot go on; what it did so far is kept
├── OutputExistsError (FileExistsError)  exit 1   a run's folder that holds something else
├── CheckpointError              exit 4   weights that cannot be read or do not fit the model
└── RecipeError                  exit 4   a training recipe that cannot be read
"""


class ModelError(ValueError):
    """Root of the errors that the models foresaw."""

    exit_code = 1


class TrainingError(ModelError):
    """A training run that cannot go on; what it did so far is kept."""


class OutputExistsError(ModelError, FileExistsError):
    """A run's folder that holds something else, which training would overwrite."""


class CheckpointError(ModelError):
    """Weights that cannot be read, or do not fit the model they are meant for."""

    exit_code = 4


class RecipeError(ModelError):
    """A training recipe that cannot be read."""

    exit_code = 4
