"""Components of a run: observer, policy, design, optimiser and learner, built from settings, saved and restored together."""

import dataclasses
import json
import math
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from softmpm import Model
from softmpm_learn import settling
from softmpm_learn.autoencoder import Autoencoder
from softmpm_learn.design import Design
from softmpm_learn.distributed import Group
from softmpm_learn.fallback import Fallback
from softmpm_learn.goals import Goals
from softmpm_learn.identity import identity, identity_of_settings
from softmpm_learn.learner import Learner
from softmpm_learn.observe import Latent, Observer, make_observer
from softmpm_learn.optimizers import make_optimizer
from softmpm_learn.policy import make_policy
from softmpm_learn.replay import Replay
from softmpm_learn.restart import Restart, is_worth
from softmpm_learn.seeding import seeded, stream_seed
from softmpm_learn.settings import Settings
from softmpm_learn.settling import Settling

if TYPE_CHECKING:
    from softmpm_learn.tasks.task import Task


OLDER = {"optimizer.settle": 0.0}
"""Settings of checkpoints that do not name them, where these are not the defaults."""


OTHERS = 6
"""Motions that are kept besides the best."""
REPEATED = 0.8
"""A best repeats itself if a further evaluation makes at least this share of its progress."""


class SettingsError(ValueError):
    """A run cannot go on with other settings than its own."""


class Run:
    """Everything that changes while a run goes on; a checkpoint is its :meth:`state_dict`.

    Attributes:
        group: The processes that share the run; all but the first do without its replay buffer.
        out: Its folder.
        worlds: Which of the worlds of the run are those of this process's model.
        iteration: Iterations done.
        observer, policy, design, optimizer: What is optimised, and how.
        learner: The learning phase, None unless the observer has an encoder.
        goals: Those of its simulations.
        safe: Values of policy and design in the last simulation that did not fail.
        best: The loss of the best motion so far, that of its evaluation if there are any, whether it lasts, and what gave it.
        others: The next best, at most :data:`OTHERS`, the better first.
        end: The iterations after which the best was evaluated for the end of the run, and its loss then; None: it was not.
        fallback: Decides when the run goes back to its best.
        restart: Decides when it begins anew.
        settling: Decides whether it settles.
    """

    def __init__(
        self,
        task: "Task",
        model: Model,
        settings: Settings,
        out: Path,
        group: Group | None = None,
        runs: int = 1,
    ):
        """``runs`` is the number of runs that share the worlds of the model, see :class:`softmpm_learn.runs.Runs`."""
        self.group = group or Group()
        self.worlds = self.group.split(settings.train.worlds)
        if runs * len(self.worlds) != model.worlds:
            share = f", {len(self.worlds)} for each process" if self.group.size > 1 else ""
            share += f", for each of {runs} runs" if runs > 1 else ""
            raise ValueError(
                f"train.worlds is {settings.train.worlds}{share}, but the model was built with {model.worlds}."
            )
        settings = settings.suited(task)
        self.task, self.model, self.settings, self.out = task, model, settings, out
        self.iteration, self.best = 0, {"loss": math.inf, "lasts": False, "iteration": -1}
        self.others: list[dict] = []
        self.end: tuple[int, float] | None = None
        self.fallback, self.restart, self.settling = Fallback(), Restart(), Settling()
        self.goals = Goals(task, model, settings.train, self.worlds)
        self.learner: Learner | None = None
        self.observer = self._make_observer(out)
        self.policy, self.design = self._make_policy("policy"), self._make_design()
        rates = list(self.policy.parameters()), list(self.design.parameters())
        self.optimizer = make_optimizer(settings.optimizer, *rates)
        self._first_rates = [group["lr"] for group in self.optimizer.param_groups]
        self.safe: list[Tensor] = []

    def _make_policy(self, name: str) -> nn.Module:
        """With first weights from the random stream of this name."""
        conf, seed = self.settings.policy, stream_seed(self.settings.train.seed, name)
        policy = make_policy(
            conf, self.observer.size, self.model.muscle_count, self.task.seconds, seed, self.goals.box
        )
        return policy.to(self.model.device, self.model.dtype)

    def _make_design(self) -> Design:
        return Design(self.settings.design, self.model, self.task.regions)

    def _make_observer(self, out: Path) -> Observer:
        seed, task = self.settings.train.seed, self.task
        with seeded(stream_seed(seed, "autoencoder")):
            observer = make_observer(self.settings.observer, self.model, task)
        if not isinstance(observer, Latent):
            return observer.to(self.model.device, self.model.dtype)
        learning = self.settings.learning
        if not observer.trained:
            learning = dataclasses.replace(learning, epochs=0)
        since_last = learning.every * self.settings.train.worlds
        replay = Replay(
            out / "replay",
            (
                -(-task.control_steps // learning.frame_every),
                observer.picture.channels,
                *observer.picture.shape,
            ),
            simulations=learning.simulations if learning.replay else since_last,
            megabytes=learning.megabytes,
            validation=learning.validation,
            worlds=self.settings.train.worlds,
            device=self.model.device,
        )
        autoencoder = observer.encoder
        assert isinstance(autoencoder, Autoencoder)
        self.learner = Learner(learning, autoencoder.to(self.model.device, self.model.dtype), replay, seed)
        observer.encoder = self.learner.encoder
        return observer

    @property
    def parameters(self) -> list[nn.Parameter]:
        """Parameters that the gradient updates: policy, then design."""
        return [*self.policy.parameters(), *self.design.parameters()]

    def snapshot(self) -> None:
        self.safe = [p.detach().clone() for p in self.parameters]

    @torch.no_grad()
    def backtrack(self) -> None:
        """Halve the step since :meth:`snapshot`."""
        for parameter, safe in zip(self.parameters, self.safe, strict=True):
            parameter.lerp_(safe, 0.5)

    @property
    def left(self) -> int:
        """Iterations that are not done."""
        return self.settings.train.iterations - self.iteration

    @property
    def settles(self) -> bool:
        """True in the last iterations of a run that settles in them."""
        return self.settling.active and self.left <= self._settling_iterations

    def begins_to_settle(self) -> bool:
        """Decide in the first of them whether it does; True if it begins."""
        return self.settling.begins(self.left, self._settling_iterations, self.is_at_work)

    @property
    def _settling_iterations(self) -> int:
        return settling.iterations(self.settings.train.iterations, self.settings.optimizer.settle)

    def would_be_best(self, loss: float, lasts: bool) -> bool:
        """True of a motion that is better than the best so far: one that lasts is better than one that does not, and of two others that
        of the lower loss.

        Args:
            loss: nan or infinite of a motion that is not known.
            lasts: See :mod:`softmpm_learn.lasting`; of no account where the motion is not worth going on with.
        """
        return math.isfinite(loss) and _rank(self._counted(loss, lasts)) < _rank(self.best)

    def _counted(self, loss: float, lasts: bool) -> dict:
        """What a motion counts by; one that is not worth going on with does not last."""
        return {"loss": loss, "lasts": lasts and self._is_worth(loss)}

    def _is_worth(self, loss: float) -> bool:
        return math.isfinite(loss) and is_worth(loss, self.settings.optimizer)

    @property
    def is_at_work(self) -> bool:
        """True if the best is worth going on with."""
        return self.best["iteration"] >= 0 and self._is_worth(self.best["loss"])

    def keep(self, loss: float, lasts: bool) -> None:
        """Keep policy and design as they are if they are the best so far, see :meth:`would_be_best`, or among the next best."""
        now = self._counted(loss, lasts) | {"iteration": self.iteration}
        full = len(self.others) == OTHERS
        if math.isfinite(loss) and not (full and _rank(now) >= _rank(self.others[-1])):
            self.rank([*self.candidates, now | self.policy_snapshot()])

    @property
    def candidates(self) -> list[dict]:
        """The best motion and the next best."""
        return [self.best] * (self.best["iteration"] >= 0) + self.others

    def rank(self, candidates: list[dict]) -> None:
        """Keep the best of some motions, and the next best."""
        self.best, *others = sorted(candidates, key=_rank)
        self.others = others[:OTHERS]

    def recount(self, loss: float, lasts: bool) -> bool:
        """Count a further evaluation of the best: True if it repeats itself, by :data:`REPEATED` of its progress, and lasts again if it
        did, or if it is not worth going on with anyway.

        A best that does not is worth the worse of both, and the best is then the best of it and of the others.

        Args:
            loss: Infinite where it failed.
        """
        best = self.best
        known = math.isfinite(loss) and not self.fallback.is_below(loss, best["loss"], REPEATED)
        if (known and lasts >= best["lasts"]) or not self.is_at_work:
            return True
        worse = self._counted(max(loss, best["loss"]), best["lasts"] and lasts)
        self.rank([best | worse, *self.others])
        return False

    def step(self) -> None:
        """Take a step along the gradient, the next one with lower rates."""
        self.snapshot()
        rates = [group["lr"] for group in self.optimizer.param_groups]
        if self.settles:
            self._scale_rates(settling.pace(self.left, self._settling_iterations))
        self.optimizer.step()
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        halving = self.settings.optimizer.halving
        if halving is not None:
            self._scale_rates(0.5 ** (1 / halving))

    def _scale_rates(self, factor: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] *= factor

    def fall_back(self) -> str:
        """Go back to the best policy and design and what they saw through, with smaller learning rates and no moments; or begin anew
        if the best is not worth it. Says which."""
        if not self.is_at_work:
            return self.begin_anew()
        self.fallback.count += 1
        return self.return_to_best(self.settings.optimizer.fallback_rate)

    def return_to_best(self, factor: float = 1.0) -> str:
        """Go back to the best policy and design and what they saw through, without moments and with so many times the learning rates.
        Says so."""
        self.load_policy(self.best)
        self.optimizer.state.clear()
        self._scale_rates(factor)
        self.snapshot()
        return f"going back to iteration {self.best['iteration']}"

    def begin_anew(self) -> str:
        """Take other first weights of the policy and the first design, with the first rates; the encoder keeps what it has learned.
        Says so."""
        self.restart, self.fallback = self.restart.next(), self.fallback.next()
        self.policy.load_state_dict(self._make_policy(f"policy {self.restart.count}").state_dict())
        self.design.load_state_dict(self._make_design().state_dict())
        self.optimizer.state.clear()
        for group, rate in zip(self.optimizer.param_groups, self._first_rates, strict=True):
            group["lr"] = rate
        self.snapshot()
        return "beginning anew with other first weights"

    @property
    def evaluated(self) -> bool:
        """True if evaluations choose the best, and not the loss of the episodes."""
        return self.goals.box is not None or (self.settings.train.endurance or 1) > 1

    def policy_snapshot(self) -> dict:
        """Copies of what decides how the robot moves, policy, design and what the policy sees through, and of the autoencoder."""
        return {
            name: {k: t.clone() for k, t in part.state_dict().items()} for name, part in self._moving.items()
        }

    def load_policy(self, snapshot: dict) -> None:
        for name, part in self._moving.items():
            part.load_state_dict(snapshot[name])

    @property
    def _moving(self) -> dict[str, nn.Module]:
        parts: dict[str, nn.Module] = {
            "observer": self.observer,
            "policy": self.policy,
            "design": self.design,
        }
        return parts if self.learner is None else parts | {"autoencoder": self.learner.autoencoder}

    def state_dict(self) -> dict:
        return {
            "iteration": self.iteration,
            "about": self.about,
            "policy": self.policy.state_dict(),
            "design": self.design.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "goals": self.goals.stream.get_state(),
            "learner": None if self.learner is None else self.learner.state_dict(),
            "safe": self.safe,
            "best": self.best,
            "others": self.others,
            "end": self.end,
            "fallback": dataclasses.asdict(self.fallback),
            "restart": dataclasses.asdict(self.restart),
            "settling": dataclasses.asdict(self.settling),
        }

    def load_state_dict(self, content: dict) -> None:
        """Go on from a checkpoint of the same task and settings; one that is older than a setting was made with its default, or without
        what :data:`OLDER` names.

        Raises:
            SettingsError: Task or settings are others; names each difference.
            ValueError, LookupError, TypeError, AttributeError, RuntimeError: It holds something else than a run.
        """
        theirs = identity_of_settings(Settings()) | OLDER | json.loads(content["about"])
        ours = json.loads(self.about)
        changed = [name for name in sorted(ours.keys() | theirs.keys()) if theirs.get(name) != ours.get(name)]
        if changed:
            both = "; ".join(f"{name}: {theirs.get(name)} then, {ours.get(name)} now" for name in changed)
            raise SettingsError(f"made with other settings: {both}")
        self.policy.load_state_dict(content["policy"])
        self.design.load_state_dict(content["design"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.goals.stream.set_state(content["goals"])
        if self.learner is not None:
            self.learner.load_state_dict(content["learner"])
        self.safe = [tensor.to(self.model.device) for tensor in content["safe"]]
        self.iteration, best = content["iteration"], content["best"]
        self.best = {"lasts": best["iteration"] >= 0} | best  # others were not known
        self.others, self.end = list(content.get("others", [])), content.get("end")
        self.fallback = Fallback(**content["fallback"])
        self.restart = Restart(**content.get("restart", {}))
        self.settling = Settling(**content.get("settling", {}))
        self._check_shapes()

    def _check_shapes(self) -> None:
        """Raise ValueError for what PyTorch does not compare when it loads: what belongs to a parameter has its shape."""
        of = [(p.shape, moment.shape) for p in self.parameters for moment in _moments(self.optimizer, p)]
        of += [(p.shape, safe.shape) for p, safe in zip(self.parameters, self.safe, strict=bool(self.safe))]
        for want, got in of:
            if want != got:
                raise ValueError(
                    f"something of shape {tuple(got)} belongs to a parameter of shape {tuple(want)}"
                )
        if not (
            isinstance(self.iteration, int)
            and self.iteration >= 0
            and self.best["iteration"] < self.iteration
        ):
            raise ValueError(
                f"the iteration is {self.iteration!r}, that of the best loss {self.best['iteration']!r}"
            )
        now = self.policy_snapshot()
        for one in self.candidates:
            self.load_policy(one)  # compares the shapes
        self.load_policy(now)

    @cached_property
    def about(self) -> str:
        """Identity of the run, which a resumed run must share, as JSON; its tensors are read once."""
        return json.dumps(identity(self.task, self.model, self.settings), sort_keys=True)


def _rank(motion: dict) -> tuple[bool, float]:
    """Lower of a better motion, see :meth:`Run.would_be_best`."""
    return not motion["lasts"], motion["loss"]


def _moments(optimizer: torch.optim.Optimizer, parameter: nn.Parameter) -> list[Tensor]:
    """State of an optimiser that has one number for each number of a parameter, such as its moments."""
    found = optimizer.state.get(parameter, {})
    return [value for name, value in found.items() if isinstance(value, Tensor) and name != "step"]
