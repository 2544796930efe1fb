"""Shared setup of all tests: quiet Warp, one thread, and fixtures for both schemes and every device, the CPU and a GPU if present."""

import gc
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib
import pytest
import torch
import warp as wp

matplotlib.use("Agg")
wp.config.log_level = wp.LOG_WARNING
torch.set_num_threads(1)

NO_GPU = "needs a CUDA GPU; PyTorch sees none here"


@pytest.hookimpl(trylast=True)  # after the order was made random
def pytest_collection_modifyitems(items):
    # A long one at the end of a random order would keep one process waiting.
    items.sort(key=lambda item: "long" not in item.keywords)
    if not torch.cuda.is_available():
        for item in items:
            if "gpu" in item.keywords:
                item.add_marker(pytest.mark.skip(reason=NO_GPU))


@pytest.fixture(scope="module", autouse=True)
def only_new_objects_are_looked_through():
    """What is there before a module stays: Python's collector of cycles would look through it again and again, in a tenth of all time
    and more where tests call it."""
    gc.collect()
    gc.freeze()


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request) -> str:
    return request.param


@pytest.fixture(params=["plain", "fast"])
def scheme(request) -> str:
    return request.param
