"""Components of a run: observer, policy, design, optimiser and learner, built from settings, saved and restored together."""

import dataclasses
import json
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import softmpm
from softmpm import Model
from softmpm_learn.design import Design, declared_inputs
from softmpm_learn.distributed import Group
from softmpm_learn.episode import need_model_of, times_of
from softmpm_learn.learning.learner import Learner, make_learner
from softmpm_learn.observe import Latent, Observer, make_observer
from softmpm_learn.observer_check import check_observer
from softmpm_learn.optimizers import make_optimizer
from softmpm_learn.policy import make_policy
from softmpm_learn.recovery import settling
from softmpm_learn.recovery.fallback import Fallback
from softmpm_learn.recovery.motions import Motions
from softmpm_learn.recovery.restart import Restart
from softmpm_learn.recovery.settling import Settling
from softmpm_learn.runs.goals import Goals
from softmpm_learn.runs.identity import check_same, identity
from softmpm_learn.runs.policy_check import check_policy
from softmpm_learn.seeding import seeded, stream_seed
from softmpm_learn.settings import Settings
from softmpm_learn.tasks.task import Task


class Run:
    """Everything that changes while a run goes on; a checkpoint is its :meth:`state_dict`.

    Attributes:
        group: The processes that share the run; all but the first do without its replay buffer.
        out: Its folder.
        name: That among the runs beside it, empty if there is none.
        worlds: Which of the worlds of the run are those of this process's model.
        iteration: Iterations done.
        observer, policy, design, optimizer: What is optimised, and how.
        learner: The learning phase, None unless the observer has an encoder.
        goals: Those of its simulations.
        safe: Values of policy and design in the last simulation that did not fail.
        motions: The best ones so far.
        end: The iterations after which the best was evaluated for the end of the run, and its loss then; None: it was not.
        fallback: Decides when the run goes back to its best.
        restart: Decides when it begins anew.
        settling: Decides whether it settles.
        saturated: The log has been told that the activations are at their bounds; no part of a checkpoint.
    """

    def __init__(
        self,
        task: Task,
        model: Model,
        settings: Settings,
        out: Path,
        group: Group | None = None,
        runs: int = 1,
    ):
        """``runs`` is the number of runs that share the worlds of the model, see :class:`softmpm_learn.runs.runs.Runs`."""
        self.group = group or Group()
        self.worlds = self.group.split(settings.train.worlds)
        if runs * len(self.worlds) != model.worlds:
            share = f", {len(self.worlds)} for each process" if self.group.size > 1 else ""
            share += f", for each of {runs} runs" if runs > 1 else ""
            raise ValueError(
                f"train.worlds is {settings.train.worlds}{share}, but the model was built with {model.worlds}."
            )
        need_model_of(task, model)
        self.task, self.model, self.settings, self.out = task, model, settings, out
        self.learner: Learner | None = None
        self.observer = self._make_observer()
        self.settings = settings = settings.suited(task, isinstance(self.observer, Latent))
        self.name, self.iteration, self.motions = "", 0, Motions(settings.optimizer)
        self.end: tuple[int, float] | None = None
        self.fallback, self.restart, self.settling = Fallback(), Restart(), Settling()
        self.goals = Goals(task, model, settings.train, self.worlds)
        self.policy, self.design = self._make_policy("policy"), self._make_design()
        groups = (list(part.parameters()) for part in (self.policy, self.design))
        self.optimizer = make_optimizer(settings.optimizer, *groups)
        self._first_rates = self._rates
        self.safe: list[Tensor] = []
        self.saturated = False

    def model_of(self, task: Task, worlds: int, inputs: Iterable[str] = ()) -> Model:
        """Model of another task, or with other worlds, built as the task says; for simulations without a gradient.

        Args:
            inputs: Names of inputs that calls will give beside those of the design, as for :func:`softmpm.build`.
        """
        own, given = self.model, (*declared_inputs(self.settings.design), *inputs)
        settings: dict[str, Any] = dict(device=own.device, dtype=own.dtype, threads=own.threads)
        settings |= dict(deterministic=own.deterministic, inputs=given, worlds=worlds)
        return softmpm.build(task.scene, **settings, **task.build)

    def _make_policy(self, name: str) -> nn.Module:
        """With first weights from the random stream of this name."""
        conf, seed = self.settings.policy, stream_seed(self.settings.train.seed, name)
        policy = make_policy(
            conf, self.observer.size, self.model.muscle_count, self.task.seconds, seed, self.goals.box
        )
        policy = policy.to(self.model.device, self.model.dtype)
        times, worlds = times_of(self.task, self.model), len(self.worlds)
        check_policy(
            conf.name, policy, self.observer.size, self.model.muscle_count, times, worlds, self.goals.middle()
        )
        return policy

    def _make_design(self) -> Design:
        return Design(self.settings.design, self.model, self.task.regions)

    def _make_observer(self) -> Observer:
        task, folder = self.task, self.out / "replay"
        with seeded(stream_seed(self.settings.train.seed, "autoencoder")):
            observer = make_observer(self.settings.observer, self.model, task)
        if not isinstance(observer, Latent):
            observer = observer.to(self.model.device, self.model.dtype)
            check_observer(observer, self.model)
            return observer
        self.learner = make_learner(self.settings, observer, task.control_steps, self.model, folder)
        observer.encoder = self.learner.encoder
        return observer

    @property
    def parameters(self) -> list[nn.Parameter]:
        """Parameters that the gradient updates: policy, then design."""
        return [p for part in (self.policy, self.design) for p in part.parameters() if p.requires_grad]

    @property
    def now(self) -> str:
        """Its iteration, and its name among several: how sentences of the log begin."""
        return f"Iteration {self.iteration}" + (f" of {self.name}" if self.name else "")

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
        return self.settling.begins(self.left, self._settling_iterations, self.motions.best_is_worth_it)

    @property
    def _settling_iterations(self) -> int:
        return settling.iterations(self.settings.train.iterations, self.settings.optimizer.settle)

    @property
    def best(self) -> dict:
        """The best motion, see :class:`softmpm_learn.recovery.motions.Motions`."""
        return self.motions.best

    def keep(self, loss: float, lasts: bool) -> None:
        """Keep policy and design as they are if they are the best so far, or among the next best; see
        :mod:`softmpm_learn.recovery.motions`."""
        self.motions.keep(loss, lasts, self.iteration, self.policy_snapshot)

    def recount(self, loss: float, lasts: bool) -> bool:
        """Count a further evaluation of the best: True if it repeats itself, see
        :meth:`softmpm_learn.recovery.motions.Motions.recount`."""
        return self.motions.recount(loss, lasts, self.fallback)

    def step(self) -> None:
        """Take a step along the gradient, the next one with lower rates."""
        self.snapshot()
        rates, halving = self._rates, self.settings.optimizer.halving
        if self.settles:
            self._set_rates(rates, settling.pace(self.left, self._settling_iterations))
        self.optimizer.step()
        self._set_rates(rates, 1.0 if halving is None else 0.5 ** (1 / halving))

    @property
    def _rates(self) -> list[float]:
        """Learning rates of policy and design."""
        return [group["lr"] for group in self.optimizer.param_groups]

    def _set_rates(self, rates: Sequence[float], factor: float = 1.0) -> None:
        """Set the learning rates to these times a factor."""
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = factor * rate

    def fall_back(self) -> str:
        """Go back to the best policy and design and what they saw through, with smaller learning rates and no moments; or begin anew
        if the best is not worth it. Says which."""
        if not self.motions.best_is_worth_it:
            return self.begin_anew()
        self.fallback.count += 1
        return self.return_to_best(self.settings.optimizer.fallback_rate)

    def return_to_best(self, factor: float = 1.0) -> str:
        """Go back to the best policy and design and what they saw through, without moments, those of the autoencoder among them, and
        with so many times the learning rates. Says so."""
        self.load_policy(self.best)
        self.optimizer.state.clear()
        if self.learner is not None:
            self.learner.optimizer.state.clear()
        self._set_rates(self._rates, factor)
        self.snapshot()
        return f"going back to iteration {self.best['iteration']}"

    def begin_anew(self) -> str:
        """Take other first weights of the policy and the first design, with the first rates; the encoder keeps what it has learned.
        Says so."""
        self.restart, self.fallback = self.restart.next(), self.fallback.next()
        self.policy.load_state_dict(self._make_policy(f"policy {self.restart.count}").state_dict())
        self.design.load_state_dict(self._make_design().state_dict())
        self.optimizer.state.clear()
        self._set_rates(self._first_rates)
        self.snapshot()
        return "beginning anew with other first weights"

    @property
    def returns(self) -> dict[str, int]:
        """Times that it fell back to its best and began anew so far, by the columns of metrics.csv."""
        return {"fallbacks": self.fallback.count, "restarts": self.restart.count}

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
        parts: dict[str, nn.Module] = dict(observer=self.observer, policy=self.policy, design=self.design)
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
            "best": self.motions.best,
            "others": self.motions.others,
            "end": self.end,
            "fallback": dataclasses.asdict(self.fallback),
            "restart": dataclasses.asdict(self.restart),
            "settling": dataclasses.asdict(self.settling),
        }

    def load_state_dict(self, content: dict) -> None:
        """Go on from a checkpoint. What PyTorch does not compare when it loads is for :func:`softmpm_learn.runs.resuming.restore`.

        Raises:
            SettingsError: Task or settings are others; names each difference.
            ValueError, LookupError, TypeError, AttributeError, RuntimeError: It holds something else than a run.
        """
        check_same(json.loads(content["about"]), json.loads(self.about))
        self.policy.load_state_dict(content["policy"])
        self.design.load_state_dict(content["design"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.goals.stream.set_state(content["goals"])
        if self.learner is not None:
            self.learner.load_state_dict(content["learner"])
        self.safe = [tensor.to(self.model.device) for tensor in content["safe"]]
        self.iteration, best, self.end = content["iteration"], content["best"], content.get("end")
        self.motions.best = {"lasts": best["iteration"] >= 0} | best  # others were not known
        self.motions.others = list(content.get("others", []))
        self.fallback = Fallback(**content["fallback"])
        self.restart = Restart(**content.get("restart", {}))
        self.settling = Settling(**content.get("settling", {}))
        now = self.policy_snapshot()
        for one in self.motions.all:
            self.load_policy(one)  # compares the shapes
        self.load_policy(now)

    @cached_property
    def about(self) -> str:
        """Identity of the run, which a resumed run must share, as JSON; its tensors are read once."""
        return json.dumps(identity(self.task, self.model, self.settings), sort_keys=True)
