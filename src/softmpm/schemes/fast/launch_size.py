"""Number of threads of the launches over particles, and the variant of the kernels for it."""

import functools

from softmpm.kernels.fast.native import BLOCK, FEW, MANY, VERY_FEW, WARP, SizeClass
from softmpm.model import Model


def size_class_of(particles: int) -> SizeClass:
    """Size class of a number of particles on a GPU."""
    if particles <= FEW:
        return SizeClass.FEW
    return SizeClass.SOME if particles <= MANY else SizeClass.MANY


class LaunchSize:
    """Threads of the launches over the particles of a model.

    On a GPU the lanes of a warp cooperate, so that whole blocks are launched. With few particles each warp has a block of its own and
    the kernels may use more registers; with very few, half of the lanes stay empty, so that twice as many warps share the work, at
    the price of more reductions (docs/decisions/0009-kept-machinery.md). With many particles an early beginning
    costs more than it gains (docs/decisions/0018-dependent-launch.md).
    """

    def __init__(self, model: Model):
        self.particles, self.on_gpu = model.worlds * model.particle_count, model.device.type == "cuda"
        self.size_class = size_class_of(self.particles) if self.on_gpu else SizeClass.SOME
        self.block = WARP if self.few else BLOCK
        may_halve = self.on_gpu and not model.spec.deterministic and self.particles <= VERY_FEW
        self.per_warp_adj = WARP // 2 if may_halve else WARP
        self.per_warp = self.per_warp_adj if model.dim == 2 else WARP
        """Particles of each warp in the forward kernels."""

    @property
    def few(self) -> bool:
        """True if each warp has a block of its own."""
        return self.size_class is SizeClass.FEW

    @functools.cached_property
    def threads(self) -> int:
        """Threads of a forward launch."""
        return self._threads(self.per_warp)

    @functools.cached_property
    def threads_adj(self) -> int:
        """Threads of an adjoint launch."""
        return self._threads(self.per_warp_adj)

    def _threads(self, per_warp: int) -> int:
        if not self.on_gpu:
            return self.particles
        warps = -(-self.particles // per_warp)
        return -(-warps * WARP // self.block) * self.block
