"""Closed loops that are simulated once for each iteration: on a GPU each is one captured graph, where the model allows it."""

import math
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

import softmpm
from softmpm import Inputs, Model, Params
from softmpm_learn.episode import Decisions, Episode, Frame, Policy, kicked, run_episode, times_of
from softmpm_learn.lasting import AGAIN, FURTHER, STARTS
from softmpm_learn.observe import Observer
from softmpm_learn.tasks.task import Task

_Outcome = tuple[Episode, tuple[Tensor, ...], list[Frame]]
"""Episode, gradients, and the frames of a captured graph, which were not passed to ``on_frames`` yet."""
OnFrames = Callable[[Sequence[Frame]], None]
"""Takes frames that are known at once, in the order of time."""


def _captures(model: Model) -> bool:
    """False if sums are in the order of the particles, which wait for the device, see docs/conventions.md."""
    return not (model.deterministic and (model.scheme == "plain" or model.dtype == torch.float64))


def starts_at_once(task: Task) -> int:
    """Number of starts from which an :class:`Evaluator` simulates a task at once."""
    return 1 if task.lasting is None else len(STARTS)


class Evaluator:
    """Simulates a task under a policy without a gradient, again and again; on a GPU as one captured graph, as :class:`ClosedLoop`.

    A GPU that simulates one robot is mostly idle, and simulates it from several starts in hardly more time than from one. So every
    world of the runs is simulated from several starts at once.

    Args:
        model: With :func:`starts_at_once` times the worlds of the runs: neighbouring worlds differ in the start alone.
        policy, design: As of :class:`ClosedLoop`, for these worlds.

    Attributes:
        at_once: Number of starts that are simulated at once.
        starts: Speeds along the first axis with which an evaluation starts [m/s]: those of :data:`softmpm_learn.lasting.STARTS` if the
            motion should last, else rest.
        further: Those of a motion that would be the best: :data:`softmpm_learn.lasting.FURTHER`, or none.
        again: Those of the best when it is evaluated again: :data:`softmpm_learn.lasting.AGAIN`, else rest.
        failures: Those of the last simulation. A robot that fails goes on from rest: frozen, it would fail again in every control
            step, and outside of a graph the simulation of all robots would be repeated each time.
    """

    def __init__(
        self,
        task: Task,
        model: Model,
        observer: Observer,
        policy: Policy,
        design: Callable[[], tuple[Params, Inputs]],
    ):
        rest = ((0.0,), (), (0.0,))
        self.starts, self.further, self.again = rest if task.lasting is None else (STARTS, FURTHER, AGAIN)
        self.at_once = starts_at_once(task)
        self.failures = failures = softmpm.Failures("reset")
        goals = list[Tensor]()  # a reference to self here would be a cycle through the graph
        self._kicks = kicks = torch.zeros(self.at_once, dtype=model.dtype, device=model.device)

        @torch.no_grad()
        def work() -> Tensor:
            params, inputs = design()
            start = kicked(model.rest(), kicks.repeat(model.worlds // len(kicks)))
            about: dict[str, Any] = dict(inputs=inputs, goal=goals[0] if goals else None)
            about |= dict(start=start, failures=failures)
            episode = run_episode(task, model, observer, policy, params, **about)
            assert episode.path is not None
            lasts = torch.ones_like(episode.loss) if task.lasting is None else task.lasting(episode.path)
            return torch.stack([episode.loss, lasts.to(episode.loss)]).unflatten(1, (-1, len(kicks)))

        self._goals, self._work = goals, work
        self._graph = softmpm.Graph(work, model.device) if _captures(model) else None

    def __call__(self, goal: Tensor | None, kicks: Sequence[float]) -> tuple[Tensor, Tensor]:
        """Loss of each world of the runs from each start, and 1 where the motion lasts or the task does not ask, else 0, shape
        (world, start) each; they mean nothing of one that failed.

        Args:
            goal: Goal of each world of the runs [m], shape (world, dim), where it is not the task's own.
            kicks: Speeds along the first axis with which they start [m/s], :attr:`at_once` of them.
        """
        if len(kicks) != self.at_once:
            raise ValueError(f"an evaluation takes {self.at_once} start(s) at once, got {len(kicks)}.")
        self.failures.errors.clear()
        self._kicks.copy_(torch.tensor(kicks, dtype=self._kicks.dtype))
        goals = None if goal is None else goal.repeat_interleave(self.at_once, dim=0)
        if goals is not None and not self._goals:
            self._goals.append(goals)
        elif goals is not None:
            self._goals[0].copy_(goals)
        loss, lasts = (self._graph() if self._graph else self._work()).clone()
        return loss, lasts


class ClosedLoop:
    """Simulates a task under a policy and differentiates the loss, again and again; on a GPU as one captured graph, where
    the model allows it.

    Args:
        policy: The policy, which may be that of several runs side by side.
        design: Gives the material and the inputs, see :class:`softmpm_learn.design.Design`.
        weights, free: Parameters of the policy and of the design.
        runs: Number of runs, each with as many worlds.
        keep_every, fade: As in :func:`run_episode`.
        records: Episodes will be recorded: a captured graph keeps the states of all control steps.
    """

    def __init__(
        self,
        task: Task,
        model: Model,
        observer: Observer,
        policy: Policy,
        design: Callable[[], tuple[Params, Inputs]],
        weights: list[Tensor],
        free: list[Tensor],
        runs: int = 1,
        keep_every: int = 0,
        fade: float | Tensor = math.inf,
        records: bool = False,
    ):
        self.fade, self.records = fade, records
        self.task, self.model, self.observer, self.policy = task, model, observer, policy
        self.design, self.weights, self.free = design, weights, free
        self.runs, self.keep_every = runs, keep_every
        self._goal: Tensor | None = None
        self._on_frames: OnFrames | None = None
        self._failures = softmpm.Failures("reset")
        self._captures = _captures(model)
        loop = weakref.proxy(self)  # a strong reference would be a cycle through the graph
        self._graph = softmpm.Graph(lambda: loop._work(), model.device)

    def __call__(
        self, goal: Tensor | None, on_frames: OnFrames | None = None
    ) -> tuple[Episode, tuple[Tensor, ...]]:
        """The episode, detached, and the gradient of each run's mean loss with respect to ``weights``, then to ``free``; overwritten
        by the next call. ``on_frames`` is called at each control step, after a replay once with all of them.

        Raises:
            softmpm.UnstableError: One of :attr:`errors`.
        """
        if goal is not None:
            self._goal = goal.clone() if self._goal is None else self._goal.copy_(goal)
        episode, gradients, frames = self._run(on_frames, self._captures and (self.records or not on_frames))
        if on_frames and frames and self._failures and self.runs == 1:
            del episode, gradients, frames  # a frame after the failure shows nothing
            episode, gradients, frames = self._run(on_frames, as_graph=False)
        if on_frames and frames:
            on_frames(frames)
        if self._failures:
            del episode, gradients, frames
            raise self._failures.errors[0]
        return episode, gradients

    def _run(self, on_frames: OnFrames | None, as_graph: bool) -> _Outcome:
        self._failures.errors.clear()
        self._on_frames = on_frames
        try:
            return self._graph() if as_graph else self._work()
        except softmpm.UnstableError as error:
            if not self._failures:  # that of a gradient, or the first of a single run
                self._failures.errors.append(error)
            raise
        finally:
            self._on_frames = None

    @property
    def errors(self) -> list[softmpm.UnstableError]:
        """Failures of the last call, those of all runs."""
        return self._failures.errors

    def _work(self) -> _Outcome:
        params, inputs = self.design()
        capturing = self.model.device.type == "cuda" and torch.cuda.is_current_stream_capturing()
        frames = list[Frame]()
        on_frames, on_frame = self._on_frames, None
        if capturing:
            on_frame = (lambda frame: frames.append(frame.detach())) if self.records else None
        elif on_frames:
            on_frame = lambda frame: on_frames([frame])  # noqa: E731
        # A failure must not hide those of other runs, and while a graph is captured none is known yet; a single run may stop at once.
        failures = self._failures if capturing or self.runs > 1 else None
        about: dict[str, Any] = dict(
            inputs=inputs, goal=self._goal, fade=self.fade, keep_every=self.keep_every
        )
        about |= dict(on_frame=on_frame, failures=failures)
        episode = run_episode(self.task, self.model, self.observer, self.policy, params, **about)
        if failures:
            try:
                raise failures.errors[0]
            finally:
                # The error would refer to itself through this frame, and keep all states of the simulation alive.
                del failures, episode, about
        activations = episode.decisions.activations
        loss = (
            episode.loss.unflatten(0, (self.runs, -1)).mean(dim=1).sum()
        )  # a run's parameters see its own worlds
        # An objective that ends before the episode does not see the last activations:
        if not loss.requires_grad:
            raise ValueError(
                "the objective has no gradient with respect to policy and design: compute its terms with operations of PyTorch from "
                "what path has, without detach(), and let a parameter of the policy have requires_grad."
            )
        acting = activations if activations[0].requires_grad else []  # none of a policy without parameters
        adj = torch.autograd.grad(loss, [*acting, *self.free], materialize_grads=True)
        adj_activations, adj_free = adj[: len(acting)], adj[len(acting) :]
        gradients = (*self._policy_gradient(episode.decisions, adj_activations), *adj_free)
        return episode.detach(), gradients, frames

    def _policy_gradient(self, decisions: Decisions, adj_activations: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Of all decisions at once: layer by layer and step by step it would be many small sums."""
        if not adj_activations:
            return tuple(torch.zeros_like(weight) for weight in self.weights)
        features, times = torch.stack(decisions.features).detach(), times_of(self.task, self.model)[:, None]
        again = self.policy(features, times, self._goal)
        adj = torch.stack(list(adj_activations))
        return torch.autograd.grad(again, self.weights, adj, materialize_grads=True)
