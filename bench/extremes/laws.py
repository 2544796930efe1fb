"""Laws of the maps."""

import softmpm

LAWS = [softmpm.NeoHookean, softmpm.FixedCorotated, softmpm.BarrierCorotated, softmpm.StableNeoHookean]
