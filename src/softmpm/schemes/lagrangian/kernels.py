"""Definition of all kernels of a Warp module before it is first loaded, so that it is compiled once."""

from softmpm.kernels.lagrangian.driven import driven, driven_adj
from softmpm.kernels.lagrangian.mirror import mirror, mirror_adj
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.surface import surface
from softmpm.kernels.lagrangian.surface_adj import surface_adj
from softmpm.kernels.structs import RequestedGrads, Spec


def define(spec: Spec) -> None:
    """Define the kernels of nodes and surface points."""
    for made, present in ((nodes, True), *zip((surface, mirror, driven), _features(spec), strict=True)):
        if present:
            made(spec)


def define_adj(spec: Spec, wanted: RequestedGrads) -> None:
    """Define their adjoints."""
    factories = (surface_adj, mirror_adj, driven_adj)
    for made, present in ((nodes_adj, True), *zip(factories, _features(spec), strict=True)):
        if present:
            made(spec, wanted)


def _features(spec: Spec) -> tuple[bool, bool, bool]:
    """True for contact at surface points, for clamps and symmetries, and for driven particles, if the scene has them."""
    return bool(spec.surface_walls), bool(spec.mirrors), spec.driven_nodes
