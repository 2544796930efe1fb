"""Modules of one structure with weights of their own, evaluated at once: one batched operation in place of one for each module.

Weights and buffers of the modules become views of tensors with a leading axis, one row for each module. So an optimiser, a checkpoint
or a target network that changes a module in place changes what is evaluated here.
"""

import logging
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call

from softmpm_learn.likeness import alike

logger = logging.getLogger("softmpm_learn")

TOLERANCE = {torch.float32: 1e-2, torch.float64: 1e-8}
"""Largest difference, relative to the largest value, of a batched evaluation from one module after another: rounding. Convolutions in
float32 have ten bits on a GPU (TF32)."""
DIFFER = "Modules %s differ in more than their weights: evaluated one after another."


class Stacked:
    """Modules evaluated at once; or one after another where they differ in more than the values of their parameters and buffers, or
    where PyTorch cannot batch them (:func:`torch.vmap`).

    Args:
        modules: Of one kind.
        dims: For each input, 0 if it has the leading axis of the modules, None if all of them get the same.
        probe: Inputs, of which the first has the leading axis, for a comparison of both ways.

    Attributes:
        batched: True if they are evaluated at once.
    """

    def __init__(self, modules: Sequence[nn.Module], dims: tuple[int | None, ...], probe: tuple):
        self.modules, self.dims = list(modules), dims
        self._rows: list[dict[str, Tensor]] = []
        self._stacks: dict[str, Tensor] = {}
        self.batched = self._are_alike()
        if self.batched:
            self._stack()
            self.batched = self._agrees(probe)

    def __call__(self, *inputs: Tensor | None) -> Tensor:
        """Output of each module, along a leading axis."""
        return self._at_once(*inputs) if self.batched else self._in_turn(*inputs)

    @property
    def weights(self) -> list[Tensor]:
        """Parameters with respect to which a gradient is taken; :meth:`split` gives each module its part."""
        if not self.batched:
            return [p for module in self.modules for p in module.parameters() if p.requires_grad]
        return [self._stacks[name] for name, p in self.modules[0].named_parameters() if p.requires_grad]

    def split(self, gradients: Sequence[Tensor]) -> list[list[Tensor]]:
        """Gradients with respect to the parameters of each module, from those with respect to :attr:`weights`."""
        if self.batched:
            return [[gradient[k] for gradient in gradients] for k in range(len(self.modules))]
        parts = iter(gradients)
        return [[next(parts) for p in module.parameters() if p.requires_grad] for module in self.modules]

    def attach(self) -> None:
        """Take over the values of weights that were replaced instead of changed in place, and make them views again."""
        if not self.batched:
            return
        for k, row in enumerate(self._rows):
            for name, tensor in row.items():
                place = self._stacks[name].detach()[k]
                if tensor.data_ptr() != place.data_ptr():
                    place.copy_(tensor.detach())
                    tensor.data = place

    def _are_alike(self) -> bool:
        first, *others = self.modules
        if all(alike(first, other, weights=False) for other in others):
            return True
        logger.info(DIFFER, type(first).__name__)
        return False

    @torch.no_grad()
    def _stack(self) -> None:
        self._rows = [
            dict(module.named_parameters()) | dict(module.named_buffers()) for module in self.modules
        ]
        for name, tensor in self._rows[0].items():
            stack = torch.stack([row[name].detach() for row in self._rows])
            self._stacks[name] = stack.requires_grad_(tensor.requires_grad)
        self._bind()

    def _bind(self) -> None:
        for k, row in enumerate(self._rows):
            for name, tensor in row.items():
                tensor.data = self._stacks[name].detach()[k]

    @torch.no_grad()
    def _agrees(self, probe: tuple) -> bool:
        """True if both ways give the same; a module may refuse the transform, or read numbers that are not its own."""
        want = self._in_turn(*probe)
        kind = type(self.modules[0]).__name__
        try:
            away = (self._at_once(*probe) - want).abs().max()
            if bool(away <= TOLERANCE.get(want.dtype, 1e-2) * want.abs().max()):
                return True
            logger.info(DIFFER, kind)
        except Exception as error:  # whatever a user's module cannot do under vmap
            logger.info("Modules %s are evaluated one after another, not batched: %s", kind, error)
        return False

    def _at_once(self, *inputs: Tensor | None) -> Tensor:
        def one(state: dict[str, Tensor], *given: Tensor | None) -> Tensor:
            return functional_call(self.modules[0], state, given)

        dims = tuple(None if value is None else dim for value, dim in zip(inputs, self.dims, strict=True))
        evaluate: Callable = torch.vmap(one, in_dims=(0, *dims))
        return evaluate(self._stacks, *inputs)

    def _in_turn(self, *inputs: Tensor | None) -> Tensor:
        def of(k: int) -> list[Tensor | None]:
            pairs = zip(inputs, self.dims, strict=True)
            return [value if dim is None or value is None else value[k] for value, dim in pairs]

        return torch.stack([module(*of(k)) for k, module in enumerate(self.modules)])
