"""The laws that the maps are drawn for."""

import softmpm

LAWS = [softmpm.NeoHookean, softmpm.FixedCorotated, softmpm.BarrierCorotated]
