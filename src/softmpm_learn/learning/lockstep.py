"""Lock step: autoencoders of one architecture trained side by side, an epoch of all of them as one CUDA graph.

Weights and moments lie in tensors of their own, a row for each learner, where a captured graph finds them again. A phase copies them in
at its beginning and out at its end, in place, so the parameters of an autoencoder may be views of something else.
"""

import math
import weakref
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

import softmpm
from softmpm_learn.autoencoder import Autoencoder
from softmpm_learn.learning.learner import Learner
from softmpm_learn.learning.replay import MANY

ALIGNED = 16
"""Each parameter begins at a multiple of so many numbers, for which matrix products are made."""


class _Loss(nn.Module):
    """The loss of an autoencoder as the output of a module, which ``functional_call`` needs."""

    def __init__(self, autoencoder: Autoencoder, kl: float | None):
        super().__init__()
        self.autoencoder, self.kl = autoencoder, kl

    def forward(self, pictures: Tensor, **terms: Tensor) -> Tensor:
        return self.autoencoder.loss(pictures, self.kl, **terms)


class LockStep:
    """Weights, moments and minibatches of several learners; one epoch of all at a time.

    Args:
        learners: Of one architecture and with equal settings.
        capture: Capture the epoch as a CUDA graph, on a GPU.

    Attributes:
        rows: Weights, first and second moments, shape (3, learner, number).
        kept: Those to go back to.
    """

    def __init__(self, learners: Sequence[Learner], capture: bool):
        first = learners[0]
        self.conf, self.capture = first.conf, capture
        self.memories = [learner.replay.memory for learner in learners]
        self._network = _Loss(first.autoencoder, self.conf.kl if self.conf.variational else None)
        scale = first.autoencoder.encoder.scale
        self.device, count = scale.device, len(learners)
        self._lay_out(count, scale.dtype)
        self._make_minibatches(first, count, scale.dtype)
        self._validation: tuple[Tensor, dict[str, Tensor]] | None = None
        lockstep = weakref.proxy(self)  # a strong reference would be a cycle through the graph
        graph = softmpm.Graph(lambda: lockstep._epoch(), self.device)
        self._run = graph if self._capturing else graph.work

    def _lay_out(self, count: int, dtype: torch.dtype) -> None:
        """A row for each learner: its parameters one after another, with gaps that stay 0."""
        self._shapes = {name: p.shape for name, p in self._network.named_parameters()}
        self._widths = [w for s in self._shapes.values() for w in (s.numel(), -s.numel() % ALIGNED)]
        self.rows = torch.zeros(3, count, sum(self._widths), dtype=dtype, device=self.device)
        self.kept = torch.zeros_like(self.rows)
        self._leaf = self.rows[0].detach().requires_grad_()
        self._buffers = {name: b.expand(count, *b.shape).clone() for name, b in self._network.named_buffers()}
        on_gpu = self.device.type == "cuda"
        self._steps = torch.zeros(count, device=self.device)
        self._first_steps = [0] * count
        params = [row.detach() for row in self.rows[0]]
        self._optimizer = torch.optim.Adam(params, lr=self.conf.rate, fused=on_gpu or None)
        for k, param in enumerate(params):
            self._optimizer.state[param] = {
                "step": self._steps[k],
                "exp_avg": self.rows[1, k],
                "exp_avg_sq": self.rows[2, k],
            }

    def _make_minibatches(self, first: Learner, count: int, dtype: torch.dtype) -> None:
        """Inputs of an epoch; random numbers are drawn on the CPU, into pinned memory if it has to be copied to a GPU."""
        batches, batch, on_gpu = self.conf.batches, self.conf.batch, self.device.type == "cuda"
        latent = first.autoencoder.encoder.centre.numel()
        self._drawn_places = torch.zeros(count, batches * batch, dtype=torch.long, pin_memory=on_gpu)
        self._drawn_noise = torch.zeros(count, batches, batch, latent, dtype=dtype, pin_memory=on_gpu)
        self._places = self._drawn_places.to(self.device)
        self._noise = self._drawn_noise.to(self.device)
        shape = (count, batches, batch, *first.replay.shape[1:])
        self._pictures = torch.zeros(shape, dtype=dtype, device=self.device)

    @property
    def _capturing(self) -> bool:
        return self.capture and self.device.type == "cuda"

    def fits(self, learners: Sequence[Learner], capture: bool) -> bool:
        """True if it was made for these learners."""
        same = len(learners) == len(self.memories) and capture == self.capture
        return same and all(
            learner.replay.memory is memory for learner, memory in zip(learners, self.memories, strict=True)
        )

    @torch.no_grad()
    def load(self, learners: Sequence[Learner]) -> None:
        """Begin a phase: copy weights, moments and held-out pictures of the learners."""
        self.rows.zero_()
        for k, learner in enumerate(learners):
            self._first_steps[k] = 0
            for parameter, views in self._views(k, self.rows, learner):
                state = learner.optimizer.state.get(parameter, {})
                views[0].copy_(parameter)
                if state:
                    views[1].copy_(state["exp_avg"])
                    views[2].copy_(state["exp_avg_sq"])
                    self._first_steps[k] = int(state["step"])
            for name, buffer in learner.autoencoder.named_buffers(prefix="autoencoder"):
                self._buffers[name][k].copy_(buffer)
        self._steps.copy_(torch.tensor(self._first_steps, dtype=torch.float32))
        self.kept.copy_(self.rows)
        self._hold_out([learner.replay.some("validation") for learner in learners])

    @torch.no_grad()
    def unload(self, k: int, learner: Learner, epochs: int) -> None:
        """End a phase of learner ``k``: its weights and moments are those kept, after so many epochs."""
        steps = self._first_steps[k] + epochs * self.conf.batches
        for parameter, views in self._views(k, self.kept, learner):
            parameter.copy_(views[0])
            if steps:
                state = learner.optimizer.state[parameter]
                state.setdefault("step", torch.tensor(0.0)).fill_(steps)
                state.setdefault("exp_avg", torch.empty_like(parameter)).copy_(views[1])
                state.setdefault("exp_avg_sq", torch.empty_like(parameter)).copy_(views[2])

    def _views(self, k: int, rows: Tensor, learner: Learner):
        """Each parameter, and its weights and moments in the row of learner ``k``."""
        pieces = rows[:, k].split(self._widths, dim=1)[::2]
        for parameter, piece in zip(learner.autoencoder.parameters(), pieces, strict=True):
            yield parameter, piece.unflatten(1, parameter.shape).unbind()

    def _hold_out(self, pictures: Sequence[Tensor]) -> None:
        """Pictures to validate on, filled up to a common number; on a GPU to the most there can be, at addresses that stay."""
        counts = [len(p) for p in pictures]
        most = min(MANY, len(self.memories[0].flatten(0, 1))) if self._capturing else max(counts)
        if not most:
            self._validation = None
            return
        if self._validation is None or not self._capturing:
            shape, equal = (len(pictures), most, *pictures[0].shape[1:]), min(counts) == most
            share = self.rows.new_zeros(shape[:2])
            terms = {} if equal and not self._capturing else {"share": share}
            self._validation = self.rows.new_zeros(shape), terms
        held, terms = self._validation
        for k, (some, count) in enumerate(zip(pictures, counts, strict=True)):
            held[k, :count].copy_(some)
            held[k, count:].zero_()
            for share in terms.values():
                share[k].zero_()
                share[k, :count].fill_(1 / max(1, count))

    def draw(self, k: int, learner: Learner) -> None:
        """Draw the minibatches of the next epoch of learner ``k`` and their noise, from its own streams."""
        batches, batch = self.conf.batches, self.conf.batch
        self._drawn_places[k] = learner.replay.draw(learner.streams["minibatches"], batches * batch)
        if self.conf.variational:
            noise = self._drawn_noise[k]
            torch.randn(noise.shape, generator=learner.streams["noise"], out=noise)

    def epoch(self) -> list[tuple[float, float, bool]]:
        """Run an epoch; for each learner the mean loss of its minibatches, the validation loss, and whether all is finite."""
        if self._places is not self._drawn_places:
            self._places.copy_(self._drawn_places, non_blocking=True)
            self._noise.copy_(self._drawn_noise, non_blocking=True)
        training, validation, finite = self._run().tolist()
        return [(t, v, bool(f)) for t, v, f in zip(training, validation, finite, strict=True)]

    def _epoch(self) -> Tensor:
        """The device's part of an epoch, shape (3, learner): it waits for no number."""
        for pictures, memory, places in zip(self._pictures, self.memories, self._places, strict=True):
            pictures.flatten(0, 1).copy_(memory.flatten(0, 1).index_select(0, places))
        group = self._optimizer.param_groups[0]
        group["capturable"] = self._capturing and torch.cuda.is_current_stream_capturing()
        losses = []
        for b in range(self.conf.batches):
            noise = {"noise": self._noise[:, b]} if self.conf.variational else {}
            loss = self._losses(self._pictures[:, b], noise)
            (gradient,) = torch.autograd.grad(loss.sum(), self._leaf)
            for param, row in zip(group["params"], gradient, strict=True):
                param.grad = row
            self._optimizer.step()
            losses.append(loss.detach())
        finite = self.rows.isfinite().all(dim=2).all(dim=0)
        return torch.stack([torch.stack(losses).mean(dim=0), self._validate(), finite.to(self.rows)])

    @torch.no_grad()
    def _validate(self) -> Tensor:
        if self._validation is None:
            return self.rows.new_full((len(self.memories),), math.nan)
        return self._losses(*self._validation)

    def validation_losses(self) -> list[float]:
        """Loss of each learner on its held-out pictures; of no meaning where there are none."""
        return self._validate().tolist()

    def _losses(self, pictures: Tensor, terms: dict[str, Tensor]) -> Tensor:
        """Loss of each learner on its own pictures (learner, picture, dim, *nodes), shape (learner,)."""
        pieces = self._leaf.split(self._widths, dim=1)[::2]
        weights = {
            name: piece.unflatten(1, shape)
            for (name, shape), piece in zip(self._shapes.items(), pieces, strict=True)
        } | self._buffers

        def loss(weights: dict[str, Tensor], pictures: Tensor, terms: dict[str, Tensor]) -> Tensor:
            return functional_call(self._network, weights, (pictures,), terms)

        if len(self.memories) > 1:
            return vmap(loss)(weights, pictures, terms)
        alone = [{name: t[0] for name, t in parts.items()} for parts in (weights, terms)]
        return loss(alone[0], pictures[0], alone[1])[None]

    def keep(self, k: int) -> None:
        """Go back here at the end, with learner ``k``."""
        self.kept[:, k].copy_(self.rows[:, k])

    def reset(self, k: int) -> None:
        """Restore the kept weights of learner ``k``, since values that are not finite could reach others through a shared kernel."""
        self.rows[:, k].copy_(self.kept[:, k])
