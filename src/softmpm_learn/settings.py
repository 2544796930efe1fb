"""Every setting of the learning loop, one small dataclass for each part of it.

Numbers that the 2019 paper "Learning-in-the-loop optimization" does not state are ours, and it states few; those taken from
elsewhere name their source. A wrong value fails where the settings are made, in a sentence.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, TypeVar

from softmpm import QUANTITIES
from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.register import LOGGERS, OBSERVERS, POLICIES
from softmpm_learn.setting_checks import lengths, not_negative, one_of, positive, share, typed
from softmpm_learn.tasks.task import Task

DESIGNS = ("particle", "region", "uniform")


@dataclass(kw_only=True)
class ObserverConf:
    """Observation of the robot by the policy."""

    name: str = "latent"
    """latent (learned from grid velocity), centroids (hand-picked regions of the task) or kmeans (clusters found at rest). For
    comparison: untrained (as latent, whose settings it has, with the random first weights) or nothing (a policy acts by its clock
    alone; without one it is constant)."""
    clusters: int = 8
    """kmeans: number of clusters."""
    latent_size: int = 8
    """latent: numbers that describe the motion. 8 is what later work of the authors uses."""
    channels: list[int] = field(default_factory=lambda: [8, 16, 32])
    """latent: channels of the encoder's convolutions, each halving the picture; the decoder mirrors them."""
    nodes: int | None = None
    """latent: most nodes of the picture along its longest axis, coarser than the grid by averaging; null: 32 in 2D, 16 in 3D, twice as
    many with follow=False."""
    follow: bool = True
    """latent: the velocity image is a window around the robot, the same on any track; False shows the whole grid, averaged over
    blocks of nodes (``nodes``)."""
    posture: bool = False
    """latent: the picture shows the displacement from rest beside the velocity, so that the policy knows the robot's posture."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of an observer of one's own."""

    def __post_init__(self):
        typed("observer", self)
        OBSERVERS.need(self.name, self.options)
        positive("observer", self, "clusters", "latent_size")
        if not self.channels or min(self.channels) < 1:
            raise ValueError(
                f"observer.channels needs at least one positive number, got {list(self.channels)}."
            )
        if self.nodes is not None and self.nodes < 4:
            raise ValueError(f"observer.nodes must be at least 4 or null, got {self.nodes}.")


@dataclass(kw_only=True)
class PolicyConf:
    """Policy, which maps an observation to the activation of each muscle, in (-1, 1)."""

    name: str = "mlp"
    """linear, tanh(Wz + b); mlp; sinusoids or knots, which are open loop and see nothing but the time."""
    hidden: list[int] = field(default_factory=lambda: [64, 64])
    """mlp: width of each hidden layer; two of 64 as in Spielberg et al. 2021 (Robotica)."""
    clock: bool | None = None
    """Show linear and mlp the time as sines and cosines. Our choice: a rhythm to start from; False is the paper's feedback. null is the
    task's: walkers have a clock, the arm, which is to rest, has none."""
    period: float = 0.4
    """Longest period of the clock and of sinusoids [s]."""
    harmonics: int = 2
    """Number of periods: period, period/2, period/3, …"""
    knots: int = 16
    """knots: values of each muscle along the episode, joined by straight lines."""
    gain: float | None = None
    """Size of the initial random weights of the last layer, in units of 1/√(its inputs), and of the values of knots; 0 starts at rest.
    null is the task's: walkers 3, the arm 0.3."""
    feature_gain: float | None = None
    """Size of the first random weights of linear and mlp that take the features, in units of those that take the clock; without a clock
    it is 1. null is the task's for features of an encoder (latent, untrained), walkers 0.3 and the arm 1, and 1 for others."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of a policy of one's own."""

    def __post_init__(self):
        typed("policy", self)
        POLICIES.need(self.name, self.options)
        positive("policy", self, "period", "harmonics")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"policy.hidden needs at least one positive width, got {list(self.hidden)}.")
        if self.knots < 2:
            raise ValueError(f"policy.knots must be at least 2, got {self.knots}.")
        not_negative("policy", self, "gain", "feature_gain")


@dataclass(kw_only=True)
class DesignConf:
    """Quantities of the robot that are optimised together with the policy, and their bounds (as Spielberg et al. 2021).

    Each has a switch with its name in ``softmpm.QUANTITIES`` and bounds: ``_factor`` in units of the scene's value, or ``_range``.
    """

    enabled: bool = True
    """False keeps the scene's values: control only."""
    per: str = "particle"
    """Unit with a separate material: particle, region (of the task) or uniform (one for the robot)."""
    young: bool = True
    """Optimise Young's modulus."""
    poisson: bool = True
    """Optimise Poisson's ratio."""
    density: bool = True
    """Optimise the density."""
    strength: bool = False
    """Optimise the strength of each muscle, whatever ``per`` is."""
    viscosity: bool = False
    """Optimise the viscosity; the scene's must be > 0."""
    young_factor: list[float] = field(default_factory=lambda: [0.7, 2.0])
    """Lowest and highest Young's modulus, in units of the scene's."""
    poisson_range: list[float] = field(default_factory=lambda: [0.2, 0.4])
    """Lowest and highest Poisson's ratio [-]; the scene's must lie between."""
    density_factor: list[float] = field(default_factory=lambda: [0.7, 2.0])
    """Lowest and highest density, in units of the scene's."""
    strength_factor: list[float] = field(default_factory=lambda: [0.5, 1.5])
    """Lowest and highest strength, in units of the scene's. Our choice: stronger muscles invert particles, see docs/results.md."""
    viscosity_factor: list[float] = field(default_factory=lambda: [0.5, 2.0])
    """Lowest and highest viscosity, in units of the scene's. Our choice: a higher one takes a smaller step."""

    def __post_init__(self):
        typed("design", self)
        one_of("design.per", self.per, DESIGNS)
        for name, quantity in QUANTITIES.items():
            if hasattr(self, f"{name}_factor"):
                bounds = list(getattr(self, f"{name}_factor"))
                if len(bounds) != 2 or not 0.0 < bounds[0] < 1.0 < bounds[1] < math.inf:
                    raise ValueError(
                        f"design.{name}_factor must be [low, high] with 0 < low < 1 < high, got {bounds}."
                    )
            if hasattr(self, f"{name}_range"):
                bounds, low, high = list(getattr(self, f"{name}_range")), quantity.low, quantity.high
                if len(bounds) != 2 or not low < bounds[0] < bounds[1] < high:
                    raise ValueError(
                        f"design.{name}_range must be [low, high] with {low:g} < low < high < {high:g}, got {bounds}."
                    )


@dataclass(kw_only=True)
class LearningConf:
    """The learning phase: how the autoencoder follows the motions that the robot comes up with."""

    every: int = 5
    """Optimisation steps between two learning phases."""
    epochs: int = 100
    """Most epochs in a learning phase. Early stopping ends most phases before; where nothing is held out yet it allows ``patience``. 0
    trains nothing: a phase then only brings the latent to mean 0 and deviation 1."""
    batches: int = 8
    """Minibatches in an epoch."""
    batch: int = 32
    """Pictures in a minibatch."""
    rate: float = 1e-3
    """Learning rate of the autoencoder (Adam)."""
    variational: bool = True
    """False trains a plain autoencoder."""
    kl: float = 1e-4
    """Weight of the Kullback-Leibler term of the variational autoencoder; the value of later work of the authors."""
    early_stopping: bool = True
    """Refinement 1: stop when the loss on iterations held out stops falling, and keep the best weights."""
    patience: int = 5
    """Epochs without a validation loss that is better by ``improvement`` before stopping."""
    improvement: float = 0.01
    """Share by which the validation loss must fall to count as better. Our choice: in a run of the biped every phase then stopped by
    itself, at a loss at most 11 % above the lowest of 60 epochs; with 0 most phases ran on for ever smaller gains."""
    validation: float = 0.2
    """Share of the iterations that are held out for validation, at most a quarter; their neighbours are used for neither."""
    replay: bool = True
    """Refinement 2: learn from many past simulations. With False a phase sees ``every`` iterations; where these are fewer than
    1/``validation``, all of them may be held out or beside one that is, and the phase is left out."""
    simulations: int = 50
    """Most simulations in the replay buffer; the oldest go first. Of many worlds it takes a share of this in each iteration."""
    megabytes: float = 256.0
    """Most memory of the replay buffer [MB], on the device of the simulation; the oldest simulations go first."""
    frame_every: int = 2
    """Control steps between two recorded pictures."""
    target_network: bool = True
    """Refinement 3: the policy uses a copy of the encoder that follows slowly; False, the encoder in training."""
    target_rate: float = 0.3
    """Fraction by which the copy moves to the trained network after a learning phase; 1 copies it, as does the first phase."""
    target_halving: float | None = 4.0
    """Learning phases in which ``target_rate`` falls by half, so that the policy's last corrections rest on features that hardly
    change; null: never. Our choice: four of five arms ended at a lower loss with it."""

    def __post_init__(self):
        typed("learning", self)
        positive("learning", self, "every", "batches", "batch", "rate", "patience")
        positive("learning", self, "simulations", "megabytes", "frame_every", "target_halving")
        share("learning", self, "target_rate")
        not_negative("learning", self, "epochs", "kl")
        if not 0.0 <= self.improvement < 1.0:
            raise ValueError(f"learning.improvement must lie in [0, 1), got {self.improvement}.")
        if not 0.0 < self.validation <= 0.25:
            raise ValueError(f"learning.validation must lie in (0, 0.25], got {self.validation}.")


@dataclass(kw_only=True)
class TrainConf:
    """The run as a whole."""

    iterations: int = 100
    """Gradient steps, each after one simulation; the paper's experiments take 100."""
    seed: int = 0
    """Everything random follows from it, in a stream of its own for each part: on a CPU, the same seed gives the same run to the last
    bit, and runs that differ in one part share the random numbers of the others."""
    seeds: int = 1
    """Number of seeds, from ``seed`` on, that learn side by side in one simulation, each as if it were alone; several processes share
    them out."""
    side_by_side: int = 1
    """Sweeps: most jobs that learn side by side in one simulation. They have the task in common and may differ in observer, policy,
    design, learning, optimiser and seed."""
    worlds: int = 1
    """Simulations side by side in each step, of all processes together; useful with random goals. Each of several seeds has so many."""
    goal_spread: list[float] = field(default_factory=list)
    """Half widths [m] of the box around the task's goal from which each simulation draws its own; empty: fixed goal."""
    evaluate_every: int = 5
    """Iterations between two evaluations, by which the best policy is chosen where goals are drawn at random or an evaluation is longer
    than an episode; each takes the time of a few simulations without gradient."""
    endurance: int | None = None
    """Length of these evaluations, in episodes: a motion that does not last is not the best (lasting.py). null is the task's, 3 for
    ours; 1: the best is that of the lowest loss."""
    evaluation_goals: int = 8
    """Random goals: least number of fixed goals in the box, the same in every run; rounded up to fill all worlds."""
    save_every: int = 1
    """Iterations between two checkpoints; a run that is killed goes back to the last one. With each come the rows of the tables since
    the one before. A checkpoint takes about 20 ms of the processor, so 200 seeds side by side save every tenth iteration or so."""
    record_every: int = 10
    """Record the first, every such, the last and the best episode to run.h5; 0 records nothing."""
    frame_every: int = 1
    """Control steps between two recorded frames; the last one is recorded in any case."""
    examine: bool = True
    """Examine the best motion at the end of a run: three times as long, kicked, with other friction, on the next finer grid. False also
    leaves out the last evaluations of the best, from other starts, after which a settled run may end with its next best instead."""
    pictures: bool = True
    """Draw loss.png, latent.png and robot.png at the end, the first and the last while the run goes on too. At the end they take about
    a second for each seed."""
    log: list[str] = field(default_factory=list)
    """Loggers beside the files of the run: tensorboard, wandb, or registered ones."""

    def __post_init__(self):
        typed("train", self)
        for name in self.log:
            if name not in LOGGERS or self.log.count(name) > 1:
                raise ValueError(
                    f"train.log must have names of loggers, each once, out of {', '.join(LOGGERS)}; got {list(self.log)}."
                )
        positive("train", self, "iterations", "seeds", "side_by_side", "worlds", "save_every", "frame_every")
        positive("train", self, "evaluate_every", "evaluation_goals", "endurance")
        not_negative("train", self, "record_every")
        lengths("train.goal_spread", self.goal_spread)


@dataclass(kw_only=True)
class Settings:
    """All of them together."""

    observer: ObserverConf = field(default_factory=ObserverConf)
    policy: PolicyConf = field(default_factory=PolicyConf)
    design: DesignConf = field(default_factory=DesignConf)
    optimizer: OptimizerConf = field(default_factory=OptimizerConf)
    learning: LearningConf = field(default_factory=LearningConf)
    train: TrainConf = field(default_factory=TrainConf)

    def suited(self, task: Task, encoded: bool) -> "Settings":
        """With a task's ``optimizer.policy_rate``, ``optimizer.fade`` [s], ``optimizer.restart_above``, ``policy.gain``,
        ``policy.feature_gain``, ``policy.clock`` and ``train.endurance`` where these leave them to it.

        Args:
            encoded: Whether the observer's features are those of an encoder, to which the task's ``feature_gain`` applies.
        """
        feature_gain = task.feature_gain if encoded else 1.0
        return dataclasses.replace(
            self,
            optimizer=_filled(
                self.optimizer, policy_rate=task.rate, fade=task.fade, restart_above=task.worth
            ),
            policy=_filled(self.policy, gain=task.gain, clock=task.clock, feature_gain=feature_gain),
            train=_filled(self.train, endurance=task.endurance),
        )


Conf = TypeVar("Conf", OptimizerConf, PolicyConf, TrainConf)


def _filled(conf: Conf, **values: Any) -> Conf:
    """A part of the settings with these values where it has None."""
    missing = {name: value for name, value in values.items() if getattr(conf, name) is None}
    return dataclasses.replace(conf, **missing)
