"""Actuators: one file for each kind of :attr:`softmpm.Scene.muscles`, named as its class in snake case.

A file has a factory ``actuator(dim, dtype)``, which gives the Warp functions

    stress(H, fibre, p) → τ                     active Kirchhoff stress [Pa] for p = activation · strength [Pa]
    stress_adj(H, fibre, p, τ̄) → ActuatorAdj    adjoints of F, of p and of the fibre direction
    piola_adj(H, fibre, p, P̄) → ActuatorAdj     the same for P = τ F⁻ᵀ
    bound(F, j, fibre, p) → K                   at least what it adds to the stiffness of (W3) [Pa]
    moduli(p) → Moduli                          what it adds to those of (Q8)

``fibre`` is the unit direction in the rest shape, not meaningful for kinds without one.
"""

import importlib
from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


def actuator(name: str, dim: int, dtype: str) -> SimpleNamespace:
    """Functions of the kind that stands in the file ``name``."""
    return importlib.import_module(f"{__name__}.{name}").actuator(dim, dtype)


@kernel_factory
def actuator_adj_type(dim: int, dtype: str):
    t = types(dim, dtype)

    @wp.struct
    class ActuatorAdj:
        F: t.mat
        active_stress: t.real
        fibre: t.vec

    return ActuatorAdj
