"""Programs that show a run while it goes on, beside its own files: TensorBoard, Weights & Biases, or one of the user's."""

from softmpm_learn.loggers import tensorboard, wandb  # registers them
from softmpm_learn.loggers.logger import Logger, Loggers, rows

__all__ = ["Logger", "Loggers", "rows", "tensorboard", "wandb"]
