"""Runs a particle-wise Warp function over an array of arguments, so that a test can hold it against NumPy or PyTorch."""

import functools

import numpy as np
import torch
import warp as wp


@functools.lru_cache(maxsize=None)
def _map(function, count: int, out, *arguments):
    """A kernel out[i] = function(a[i], b[i], ...), for up to five arguments."""
    A, B, C, D, E = (*arguments, *(wp.float32,) * (5 - count))

    if count == 1:

        @wp.kernel(module="unique", enable_backward=False)
        def kernel(x: wp.array(dtype=A), result: wp.array(dtype=out)):
            i = wp.tid()
            result[i] = function(x[i])
    elif count == 2:

        @wp.kernel(module="unique", enable_backward=False)
        def kernel(x: wp.array(dtype=A), y: wp.array(dtype=B), result: wp.array(dtype=out)):
            i = wp.tid()
            result[i] = function(x[i], y[i])
    elif count == 3:

        @wp.kernel(module="unique", enable_backward=False)
        def kernel(
            x: wp.array(dtype=A), y: wp.array(dtype=B), z: wp.array(dtype=C), result: wp.array(dtype=out)
        ):
            i = wp.tid()
            result[i] = function(x[i], y[i], z[i])
    elif count == 4:

        @wp.kernel(module="unique", enable_backward=False)
        def kernel(
            x: wp.array(dtype=A),
            y: wp.array(dtype=B),
            z: wp.array(dtype=C),
            u: wp.array(dtype=D),
            result: wp.array(dtype=out),
        ):
            i = wp.tid()
            result[i] = function(x[i], y[i], z[i], u[i])
    else:

        @wp.kernel(module="unique", enable_backward=False)
        def kernel(
            x: wp.array(dtype=A),
            y: wp.array(dtype=B),
            z: wp.array(dtype=C),
            u: wp.array(dtype=D),
            v: wp.array(dtype=E),
            result: wp.array(dtype=out),
        ):
            i = wp.tid()
            result[i] = function(x[i], y[i], z[i], u[i], v[i])

    return kernel


def apply(function, out, out_shape, *arguments: tuple[torch.Tensor, object]) -> torch.Tensor:
    """``function`` on each row of the arguments, given as (tensor, Warp type); a tensor with rows of ``out_shape``."""
    tensors, dtypes = zip(*arguments, strict=True)
    wp.init()
    kernel = _map(function, len(tensors), out, *dtypes)
    result = torch.empty(len(tensors[0]), *out_shape, dtype=tensors[0].dtype, device=tensors[0].device)
    arrays = [
        wp.from_torch(t.contiguous(), dtype=dtype)
        for t, dtype in zip((*tensors, result), (*dtypes, out), strict=True)
    ]
    wp.launch(kernel, dim=len(result), inputs=arrays, device=wp.device_from_torch(result.device))
    return result


def special_deformations(dim: int) -> dict[str, torch.Tensor]:
    """Deformation gradients at which rotations are commonly differentiated wrongly; float64."""
    generator = torch.Generator().manual_seed(3)

    def rotation():
        q, r = torch.linalg.qr(torch.randn(dim, dim, generator=generator, dtype=torch.float64))
        q = q * torch.sign(torch.diagonal(r))
        return (
            q * torch.linalg.det(q) if dim % 2 else torch.cat([q[:, :-1], q[:, -1:] * torch.linalg.det(q)], 1)
        )

    eye = torch.eye(dim, dtype=torch.float64)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0][:dim], dtype=torch.float64))
    equal = torch.diag(torch.tensor([1.0, 2.0, 1.0][:dim], dtype=torch.float64))
    inverted = torch.diag(torch.tensor([-0.4, 1.1, 0.9][:dim], dtype=torch.float64))
    return {
        "identity": eye,
        "rotation": rotation(),
        "half turn": half_turn,
        "uniform stretch": 1.7 * rotation(),
        "equal stretches": rotation() @ equal @ rotation(),
        "equal stretches along the axes": equal,
        "slender": rotation()
        @ torch.diag(torch.tensor([8.0, 0.2, 0.1][:dim], dtype=torch.float64))
        @ rotation(),
        "inverted": rotation() @ inverted @ rotation(),
        "nearly flat": rotation()
        @ torch.diag(torch.tensor([1.0, 1e-7, 0.8][:dim], dtype=torch.float64))
        @ rotation(),
        "small strain": eye + 1e-6 * torch.randn(dim, dim, generator=generator, dtype=torch.float64),
        "random": torch.randn(dim, dim, generator=generator, dtype=torch.float64) + 2 * eye,
    }


def svd_rotation(F: np.ndarray) -> np.ndarray:
    """The proper rotation nearest to F: U diag(1, …, det UVᵀ) Vᵀ."""
    U, _, Vt = np.linalg.svd(F)
    sign = np.ones(F.shape[:-1])
    sign[..., -1] = np.sign(np.linalg.det(U @ Vt))
    return (U * sign[..., None, :]) @ Vt
