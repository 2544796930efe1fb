"""Launches on the CPU in parts, which threads run at the same time.

A program is a list of launches. Threads take the parts of a launch from counters, and begin the next launch when all of them are done
or, if it may run beside this one, before. A thread may come late or not at all: the others do its work.
"""

from pathlib import Path

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory

COUNT_BYTES = 64
"""Bytes of the counters of a launch: a cache line."""
SECTIONS = 8
"""Sections of the parts of a launch, each with a counter."""
HEADER = f"#define SOFTMPM_SECTIONS {SECTIONS}\n" + Path(__file__).with_name("parts.h").read_text()
FLUSHING = Path(__file__).with_name("flushing.h").read_text()


def in_parts(source: str = "", before: str = "") -> wp.ModuleBuildOptions:
    """Build options of kernels of up to three dimensions that may be launched in parts.

    Args:
        source: Native code on every device.
        before: Further code on the CPU, before the other.
    """
    on_cpu = HEADER + before + source
    return wp.ModuleBuildOptions(extra_cuda_preamble=source, extra_cpu_preamble=on_cpu)


def may_be_divided(kernel: wp.Kernel) -> bool:
    """True if the kernel's module has these options."""
    build = kernel.module.options.get("extra_build_options")
    return build is not None and build.extra_cpu_preamble.startswith(HEADER)


@kernel_factory
def runner() -> wp.Kernel:
    """Kernel that takes part in the launches from ``first`` to ``last`` of a program, without denormal numbers."""

    @wp.func_native(
        "softmpm::Flushing flushing; "
        "softmpm::run_parts(reinterpret_cast<const softmpm::Row*>(program), reinterpret_cast<softmpm::Count*>(counts), "
        "reinterpret_cast<wp::int32*>(stop), reinterpret_cast<softmpm::GiveWay>(give_way), helper, section, first, last);"
    )
    def run_parts(
        program: wp.int64,
        counts: wp.int64,
        stop: wp.int64,
        give_way: wp.int64,
        helper: bool,
        section: int,
        first: int,
        last: int,
    ): ...

    @kernel({"extra_build_options": in_parts(before=FLUSHING)})
    def run(
        program: wp.int64,  # address of one row for each launch
        counts: wp.int64,  # address of the counters, zero at the start
        stop: wp.int64,
        give_way: wp.int64,  # address of a function that lets other threads run
        helper: bool,
        section: int,  # where this thread begins
        first: int,
        last: int,
    ):
        run_parts(program, counts, stop, give_way, helper, section, first, last)

    return run
