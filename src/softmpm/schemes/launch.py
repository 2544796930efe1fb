"""Repeated kernel launches: single ones that are rebound to new arrays, and lists on fixed arrays, as CUDA graphs or CPU programs."""

import copy
import ctypes
import functools
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp

from softmpm.kernels.compile import THREADS, compile_together, launch, runs_in_order
from softmpm.kernels.dependent import awaits_previous
from softmpm.model import Model
from softmpm.schemes.capture import exclusive_capture, is_capturing
from softmpm.schemes.child_graph import add_child
from softmpm.schemes.dependent_launch import begin_early
from softmpm.schemes.device import stream_of
from softmpm.schemes.program import Divided, Program


class KernelLauncher:
    """Launches kernels on one stream, or collects the launches so that they can be repeated."""

    def __init__(self, model: Model, stream: wp.Stream | None, collected: list | None = None):
        self.device, self.stream, self.collected = model.wp_device, stream, collected
        self._threads = model.threads
        self._templates: dict[tuple, LaunchTemplate] = {}

    def __call__(
        self,
        kernel,
        dim,
        *inputs,
        block_dim: int = THREADS,
        part: int | None = None,
        beside: bool = False,
    ) -> None:
        """Launch a kernel.

        Args:
            part: Threads in each of the parts into which a CPU divides the launch; None if it must not be divided. The module of the
                kernel needs the build options :func:`softmpm.kernels.parts.in_parts`.
            beside: A CPU may begin it before the launch before it is done.
        """
        size = dim if isinstance(dim, int) else math.prod(dim)
        divided = self.collected is None and self.device.is_cpu and part is not None and size > part
        if self.device.is_cuda and runs_in_order(kernel):
            launch(kernel, dim, inputs, self.device, stream=self.stream, block_dim=block_dim)
            return
        made = self._recorded(kernel, dim, inputs, block_dim)
        if self.collected is not None:
            self.collected.append(Divided(made, part, beside))
        elif divided:
            Program([Divided(made, part)]).run(self._threads)
        else:
            made.launch(self.stream)

    def _recorded(self, kernel, dim, inputs: Sequence, block_dim: int) -> wp.Launch:
        """A launch that has not run yet."""
        key = kernel, dim, block_dim
        if key in self._templates:
            return self._templates[key].on(inputs)
        made: Any = launch(kernel, dim, inputs, self.device, block_dim=block_dim, record_cmd=True)
        self._templates[key] = LaunchTemplate(made)
        return made


def launcher(model: Model) -> KernelLauncher:
    """The model's launcher of single kernels on PyTorch's current stream; it repeats the launches recorded in earlier calls."""
    stream = stream_of(model.device)
    key = launcher, None if stream is None else stream.cuda_stream
    return model.workspace.get(key, lambda: KernelLauncher(model, stream))


class LaunchTemplate:
    """A recorded launch, to be repeated on other inputs: the checks and look-ups of ``wp.launch`` take ten times as long as a launch.

    The inputs must have the types of the first ones, which Warp has checked.
    """

    def __init__(self, made: Any):
        self._made, kinds = copy.copy(made), [type(value) for value in made.params[1:]]
        self._kinds = [(kind, issubclass(kind, ctypes.Structure)) for kind in kinds]
        self._addresses = ctypes.c_void_p * len(made.params)
        # The first inputs must not live as long as the template:
        self._made.params = made.params[:1]
        self._made.fwd_args = ()

    def on(self, inputs: Sequence) -> wp.Launch:
        """The same launch on other inputs, which it keeps alive."""
        made: Any = object.__new__(wp.Launch)  # copy.copy takes 3 to 5 µs more
        made.__dict__.update(self._made.__dict__)
        pairs = zip(self._kinds, inputs, strict=True)
        made.params = [made.bounds, *[_native(kind, v) if native else kind(v) for (kind, native), v in pairs]]
        made.fwd_args = inputs
        if made.params_addr is not None:
            made.params_addr = self._addresses(*map(ctypes.addressof, made.params))
        return made


def _native(kind: type, value: Any) -> Any:
    """An array or a struct as the native value of a type."""
    found = value if type(value) is kind else value.__ctype__()
    assert type(found) is kind, f"a repeated launch got {type(found)}, the first one {kind}"
    return found


class RebindableLaunch:
    """A stored kernel launch whose array arguments are rebound by address before each launch.

    Args:
        inputs: Inputs of the kernel, some of which are placeholders, or structs that hold placeholders.
        placeholders: Those of the inputs, from :func:`softmpm.schemes.buffers.placeholder`. They are written in place, so no other
            launch may use them.
    """

    def __init__(self, model: Model, kernel, dim, inputs: Sequence, placeholders: Sequence):
        self._placeholders = placeholders
        made = launch(kernel, dim, inputs, device=model.wp_device, record_cmd=True)
        assert made is not None
        self._launch, self._filling = made, threading.Lock()

    def __call__(self, stream: wp.Stream | None, *tensors: torch.Tensor) -> None:
        """Launch on contiguous tensors of the placeholders' shapes and precision.

        A backward pass runs in a thread of its own and shares launches with the thread of the call, hence the lock.
        """
        assert all(tensor.is_contiguous() for tensor in tensors)
        tensors = tuple(tensor.resolve_neg() for tensor in tensors)
        with self._filling:
            for placeholder, tensor in zip(self._placeholders, tensors, strict=True):
                placeholder.data = tensor.data_ptr()
            self._launch.launch(stream)


class KernelList(KernelLauncher):
    """Lists the kernels, with the threads of a block, instead of launching them."""

    def __init__(self, model: Model):
        super().__init__(model, None)
        self.found: dict[tuple[wp.Kernel, int], None] = {}

    def __call__(self, kernel, dim, *inputs, block_dim: int = THREADS, **division) -> None:
        self.found[kernel, block_dim] = None


class CapturedLaunches(KernelLauncher):
    """Launches kernels on a capturing stream.

    Attributes:
        waiting: Functions of those that wait for the previous kernel, as handles of the driver.
    """

    def __init__(self, model: Model, stream: wp.Stream):
        super().__init__(model, stream)
        self.waiting: set[int] = set()

    def _recorded(self, kernel, dim, inputs: Sequence, block_dim: int) -> wp.Launch:
        made: Any = super()._recorded(kernel, dim, inputs, block_dim)
        if awaits_previous(kernel):
            self.waiting.add(made.hooks.forward)
        return made


class LaunchReplay:
    """Captures ``launches(launcher)`` on first use, as a CUDA graph or, on the CPU, as a program, and replays it.

    The function is passed at each use and not stored, since its owner holds this object.

    While PyTorch captures a CUDA graph, the launches become part of that graph, as one child node if they were captured
    before. Warp's CPU graphs would also capture what other threads launch meanwhile.
    """

    def __init__(self, model: Model):
        self.model = model
        self._graph: wp.Graph | None = None
        self._program: Program | None = None

    def run(self, stream: wp.Stream | None, launches: Callable[[KernelLauncher], None]) -> None:
        if stream is None:
            self._run_program(launches)
        elif is_capturing(self.model):
            if self._graph is None:
                launches(KernelLauncher(self.model, stream))
            else:
                add_child(self._graph, stream)
        else:
            if self._graph is None:
                self._compile(launches)
                self._graph = self._capture(launches)
            if self._graph is None:
                launches(KernelLauncher(self.model, stream))
            else:
                wp.capture_launch(self._graph, stream=stream)

    def _run_program(self, launches: Callable[[KernelLauncher], None]) -> None:
        if self._program is None:
            self._compile(launches)
            collected = []
            launches(KernelLauncher(self.model, None, collected))
            self._program = Program(collected)
        self._program.run(self.model.threads)

    def _compile(self, launches: Callable[[KernelLauncher], None]) -> None:
        kernels = KernelList(self.model)
        launches(kernels)
        compile_together(kernels.found, self.model.wp_device)

    def _capture(self, launches: Callable[[KernelLauncher], None]) -> wp.Graph | None:
        """The captured graph; None if another thread is capturing: waiting for it could deadlock."""
        with exclusive_capture(wait=False) as acquired:
            if not acquired:
                return None
            stream = _capture_stream(self.model.device)
            launcher = CapturedLaunches(self.model, stream)
            with wp.ScopedCapture(stream=stream, force_module_load=False) as capture:
                launches(launcher)
            assert capture.graph is not None
            begin_early(capture.graph, launcher.waiting)
            return capture.graph


@functools.lru_cache(maxsize=None)
def _capture_stream(device: torch.device) -> wp.Stream:
    """Stream on which chunk graphs are captured, one at a time. PyTorch reuses the streams of its pools, and launches of another
    thread on a capturing stream would become part of the graph; the high-priority pool is rarely used.
    """
    return wp.stream_from_torch(torch.cuda.Stream(device, priority=-1))
