"""TargetNetwork: the slowly following copy that a policy uses while the network itself is in training.

Mnih et al. 2015, "Human-level control", copy every so often; Lillicrap et al. 2016 move a share of the way, as here:

    θ' ← θ' + τ (θ − θ')        (L2)
"""

import copy

import torch
from torch import Tensor, nn


class TargetNetwork(nn.Module):
    """A copy of a network, its weights and buffers (so also its normalisation) following by (L2); never trained itself."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.copy = copy.deepcopy(network).requires_grad_(False)

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.copy(*inputs)

    @torch.no_grad()
    def follow(self, network: nn.Module, rate: float) -> None:
        """(L2) with τ = ``rate``; 1 copies exactly."""
        if not 0.0 < rate <= 1.0:
            raise ValueError(f"the rate of a target network must lie in (0, 1], got {rate}.")
        source = network.state_dict()
        for name, tensor in self.copy.state_dict().items():
            if rate == 1.0:
                tensor.copy_(source[name])
            else:
                tensor.lerp_(source[name], rate)
