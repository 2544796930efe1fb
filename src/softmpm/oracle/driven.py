"""Driven particles of total Lagrangian MPM in plain float64 PyTorch. Part of :mod:`softmpm.oracle.lagrangian`.

The nodes of a driven particle have the velocity of an affine field, fitted to the driven particles near them. Derivation:
docs/math/lagrangian.md.

    v'_i = V_i,   u'_i = u_i + Δt V_i                                                        (Q10)
    V_i = Σ a_ip V_p,  the value at X_i of the weighted least-squares fit of c + G (X − X_i) to the V_p         (Q11)
"""

import torch
from torch import Tensor

from softmpm.oracle.walls import nodes as nodes_of
from softmpm.scene.scene import Scene


def held(scene: Scene, node: Tensor, N: Tensor) -> Tensor:
    """Flat indices of the nodes of driven particles, of the stencils (particle, 3^dim) of all particles."""
    driven = torch.tensor(list(scene.driven))
    return node[driven][N[driven] > 1e-12].unique()


def fit(scene: Scene, X: Tensor, node: Tensor) -> Tensor:
    """a (Q11), shape (node, driven), from all rest positions ``X`` [m] and the flat indices of the nodes.

    Directions in which the particles of a node spread by less than a tenth of a cell are left out, after particles up to 2.5 cells away
    have been tried.
    """
    places = X[torch.tensor(list(scene.driven))]
    rows = []
    for X_i in nodes_of(scene)[node]:
        r = (places - X_i) / scene.grid.spacing
        row, spreads = _row(r, 1.0)
        rows.append(row if spreads else _row(r, 0.6)[0])
    return torch.stack(rows)


def _row(r: Tensor, scale: float) -> tuple[Tensor, bool]:
    far = (scale * r).abs()
    weight = torch.where(far < 0.5, 0.75 - far**2, 0.5 * (1.5 - far).clamp(min=0) ** 2).prod(-1)
    share = weight / weight.sum()
    c = share @ r
    S = torch.cov(r.T, correction=0, aweights=weight).reshape(r.shape[1], -1)
    inverse = torch.linalg.pinv(S, atol=0.01, rtol=0.0, hermitian=True)
    return share * (1 - (r - c) @ inverse @ c), bool(torch.linalg.eigvalsh(S)[0] > 0.01)
