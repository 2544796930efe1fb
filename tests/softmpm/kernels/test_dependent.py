"""Kernels that begin before the previous one has ended, compiled for sm_90: they wait for what it writes."""

import ast
import dataclasses
import re
from pathlib import Path
from typing import Any

import cubin
import ptx
import pytest
import sm90
import torch
import warp as wp

from softmpm import kernels
from softmpm.kernels.carried.grid_stage import contact_stage, contact_stage_adj
from softmpm.kernels.carried.surface import surface
from softmpm.kernels.carried.surface_adj import surface_adj
from softmpm.kernels.dependent import awaits_previous
from softmpm.kernels.fast.fixed_point import fixed
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.native import BLOCK, SizeClass
from softmpm.kernels.lagrangian import surface as rest_surface
from softmpm.kernels.lagrangian import surface_adj as rest_surface_adj
from softmpm.kernels.lagrangian.bricks import bricks_for
from softmpm.kernels.lagrangian.cells import cells, cells_adj
from softmpm.kernels.lagrangian.cluster import Cluster
from softmpm.kernels.lagrangian.lattice import lattice_cells, lattice_cells_adj
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.persistent import march, march_adj
from softmpm.kernels.structs import RequestedGrads, Spec

SPEC = Spec(
    dim=2,
    dtype="float32",
    laws=("neo_hookean",),
    muscle_slots=0,
    contacts=("separate",),
    friction=True,
    gravity=True,
    damping=False,
    surface=True,
)
WITHOUT = dataclasses.replace(SPEC, surface=False)
NONE = RequestedGrads()
GPU = torch.device("cuda")
CELLS, LATTICE = (bricks_for(2, 5000, GPU, torch.float32, places) for places in (0, 2))
KERNELS = {
    "grid_velocity": lambda: fused(WITHOUT).grid_velocity,
    "p2g_first": lambda: fused(SPEC).p2g_first,
    "g2p2g": lambda: fused(SPEC).g2p2g[SizeClass.FEW],
    "g2p2g of some particles": lambda: fused(SPEC).g2p2g[SizeClass.SOME],
    "grid_velocity_adj": lambda: fused_adj(WITHOUT, NONE).grid_velocity_adj,
    "g2p2g_adj": lambda: fused_adj(SPEC, NONE).g2p2g_adj[True],
    "g2p2g_adj of many particles": lambda: fused_adj(SPEC, NONE).g2p2g_adj[False],
    "push": lambda: fixed(2).push,
    "grid_and_loads": lambda: contact_stage(SPEC).grid_and_loads,
    "grid_and_loads_adj": lambda: contact_stage_adj(SPEC, NONE),
    "press": lambda: surface(SPEC, True).press,
    "press_adj": lambda: surface_adj(SPEC, NONE, True, True).press_adj,
    "press_adj of few lanes": lambda: surface_adj(SPEC, NONE, True, False).press_adj,
    "advance": lambda: nodes(SPEC).advance,
    "advance_adj": lambda: nodes_adj(WITHOUT, NONE).advance_adj,
    "gather_adj": lambda: nodes_adj(SPEC, NONE).gather_adj,
    "forces of cells": lambda: cells(SPEC, CELLS).forces,
    "forces_adj of cells": lambda: cells_adj(SPEC, NONE, CELLS).forces_adj,
    "forces of a lattice": lambda: lattice_cells(SPEC, LATTICE).forces,
    "forces_adj of a lattice": lambda: lattice_cells_adj(SPEC, NONE, LATTICE).forces_adj,
    "press at rest": lambda: rest_surface.surface(SPEC).press,
    "settle at rest": lambda: rest_surface.surface(SPEC).settle,
    "settle_adj at rest": lambda: rest_surface_adj.surface_adj(SPEC, NONE).settle_adj,
    "press_adj at rest": lambda: rest_surface_adj.surface_adj(SPEC, NONE).press_adj,
    "spread_adj at rest": lambda: rest_surface_adj.surface_adj(SPEC, NONE).spread_adj,
}
"""Those of a substep on a GPU, each of some scene."""


CONSTANT = {"constants", "window", "outline", "owner", "rate", "inside", "inputs", "body", "order"}
"""Arguments that nothing writes while a chunk runs; numbers are constant as well."""
STORED = {
    "grid_velocity_adj": {"node", "node_before"},
    "grid_and_loads_adj": {"node", "node_before", "impulse"},
    "press_adj": {"node", "anchor"},
    "press_adj of few lanes": {"node", "anchor"},
}
"""What adjoint kernels read of the forward pass, which nothing writes while they run."""
OLDER = {
    "g2p2g": {"now.base", "now.rows"},
    "g2p2g of some particles": {"now.base", "now.rows"},
    "g2p2g_adj": {"now.base", "now.rows"},
    "press": {"now.base", "now.rows", "anchor", "force"},
    "press_adj": {"now.base", "now.rows", "adj_force", "adj_anchor", "free", "load"},
    "press_adj of few lanes": {"now.base", "now.rows", "adj_force", "adj_anchor", "free", "load"},
    "grid_and_loads_adj": {f"{state}.{field}" for state in ("now", "before") for field in ("base", "rows")},
    "advance": {"at.mass"},
    "advance_adj": {"at.mass"},
    "settle_adj at rest": {"at.mass"},
    "spread_adj at rest": {"at.mass"},
}
"""What else kernels read before they wait: the previous kernel does not write it (launches.py and launches_adj.py of the schemes), but
an earlier one of the same graph may."""


def code_of(name: str) -> tuple[wp.Kernel, str]:
    """A kernel and its PTX."""
    kernel = KERNELS[name]()
    threads = LATTICE.threads if "lattice" in name else CELLS.threads if "cells" in name else BLOCK
    return kernel, ptx_of(kernel, threads)


def ptx_of(kernel: wp.Kernel, threads: int) -> str:
    file = sm90.compiled(kernel, ptx=True, block_dim=threads)
    entry = re.compile(rf"{kernel.key}_\w*_cuda_kernel_forward")
    (code,) = (code for found, code in cubin.entries(file.read_text()).items() if entry.fullmatch(found))
    return code


def argument(kernel: wp.Kernel, parameter: ptx.Parameter) -> str | None:
    """Name of an argument or of a field of it; None for a number."""
    number, offset = parameter
    if number == 0:  # the size of the launch
        return None
    one: Any = kernel.adj.args[number - 1]
    kinds = {0: (one.label, one.type)}
    if getattr(one.type, "ctype", None) is not None:
        fields = {getattr(one.type.ctype, name).offset: name for name, _ in one.type.ctype._fields_}
        kinds = {at: (f"{one.label}.{name}", one.type.vars[name].type) for at, name in fields.items()}
    name, kind = kinds[max(at for at in kinds if at <= offset)]
    return name if isinstance(kind, wp.array) else None


@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_waits_for_what_the_previous_one_writes(name):
    """Until then it reads what is older or constant, on every way through its code, and writes nothing."""
    kernel, code = code_of(name)
    assert awaits_previous(kernel)
    found = {
        operation: {argument(kernel, parameter) for parameter in parameters} - {None}
        for operation, parameters in ptx.touched(ptx.until(code, "griddepcontrol.wait")).items()
    }
    assert set(found) <= {"ld", "ld.cg"}  # not of read-only memory, and no stores
    plain = {one for one in found.get("ld", ()) if one.split(".")[0] not in CONSTANT}
    recent = {one for one in found.get("ld.cg", ()) if one.split(".")[0] not in CONSTANT}
    assert (plain, recent) == (STORED.get(name, set()), OLDER.get(name, set()))
    assert "ld.global.nc" not in code  # which a kernel that has begun must not see change


@pytest.mark.parametrize("name", KERNELS)
def test_all_threads_of_a_launch_wait(name):
    """Only those beyond its size leave before."""
    early = ptx.until(code_of(name)[1], "griddepcontrol.wait")
    (predicate,) = ptx.leaves(early)
    (size,) = (
        line.rpartition(" ")[2].strip(";")
        for line in early
        if f"{predicate}," in line and "setp.ge.u64" in line
    )
    assert any(size in line and "_param_0+" in line for line in early)


@pytest.mark.parametrize("name", KERNELS)
def test_the_next_kernel_begins_after_the_wait(name):
    """Then all kernels but the previous one have ended when a kernel begins."""
    code = code_of(name)[1]
    assert code.count("griddepcontrol.wait") == code.count("griddepcontrol.launch_dependents") > 0
    for after in code.split("griddepcontrol.wait")[1:]:
        assert re.match(r";\s*// end inline asm\s*// begin inline asm\s*griddepcontrol.launch", after)


def test_all_kernels_that_wait_are_here():
    """By the functions that make the call."""
    makers = set()
    for path in Path(kernels.__file__).parent.rglob("*.py"):
        for function in ast.walk(ast.parse(path.read_text())):
            if isinstance(function, ast.FunctionDef) and any(map(_waits, function.body)):
                makers.add((path, function.name))
    found = (
        (kernel.func.__code__.co_filename, kernel.func.__name__) for kernel in (k() for k in KERNELS.values())
    )
    assert {(Path(path), name) for path, name in found} == makers


def _waits(statement: ast.stmt) -> bool:
    """True if the call is in this statement of a kernel, which has no functions inside."""
    if any(isinstance(one, ast.FunctionDef) for one in ast.walk(statement)):
        return False
    names = {
        one.func.id
        for one in ast.walk(statement)
        if isinstance(one, ast.Call) and isinstance(one.func, ast.Name) and not one.args
    }
    return not names.isdisjoint({"await_previous", "wait"})


def test_a_kernel_that_loads_nodes_as_read_only_memory_does_not_wait():
    """It begins when the previous one, which writes them, has ended."""
    kernel = fused(SPEC).g2p2g[SizeClass.MANY]
    code = ptx_of(kernel, BLOCK)
    assert not awaits_previous(kernel) and "griddepcontrol" not in code
    found = ptx.touched(ptx.until(code, "no such instruction"))["ld.nc"]
    constant = {argument(kernel, parameter) for parameter in found} - {None}
    assert constant == {"velocity"}  # not the state, which may be stored in place


def test_other_kernels_do_not_wait():
    """Those that run once in a chunk have a dependency on the end of the previous one."""
    cluster = Cluster(CELLS, blocks=8, groups=1)
    for kernel in (fused(SPEC).clear, march(WITHOUT, cluster), march_adj(WITHOUT, NONE, cluster)):
        assert not awaits_previous(kernel)
