"""Pictures of a run, and tables and pictures of sweeps: ``python -m softmpm_learn.figures FOLDER``."""

from softmpm_learn.figures.of_run import VALUES, latent_figure, loss_figure, robot_figure

__all__ = ["VALUES", "latent_figure", "loss_figure", "robot_figure"]
