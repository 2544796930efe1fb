"""Kernels compiled here for a GPU that need not be here: sm_90, as for an H100."""

from pathlib import Path
from typing import Any

import pytest
import warp as wp

ARCH = 90


def compiled(kernel: wp.Kernel, *, ptx: bool, **options: Any) -> Path:
    """The kernel's module with these compile options, from Warp's cache if nothing has changed; skips without a compiler.

    A module keeps its options, and kernels are shared by scenes and thus by tests: they are put back.
    """
    wp.init()
    if ARCH not in wp.get_cuda_supported_archs():
        pytest.skip(f"this Warp has no compiler for sm_{ARCH} (NVRTC)")
    before = dict(kernel.module.options)
    wp.set_module_options(options, module=kernel.module)
    try:
        (file,) = wp.compile_aot_module(kernel.module, arch=ARCH, use_ptx=ptx)
    finally:
        wp.set_module_options(before, module=kernel.module)
    return file
