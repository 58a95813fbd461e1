"""One Taichi runtime for the whole session; DIFFSIM_TI_ARCH names another backend (tests/test_vulkan.py uses it)."""

import os

import pytest

import diffsim_ti


@pytest.fixture(scope="session", autouse=True)
def taichi():
    diffsim_ti.init(os.environ.get("DIFFSIM_TI_ARCH", "cpu"), precision="f64")


@pytest.fixture(scope="module", autouse=True)
def default_precision(taichi):
    """What a file leaves behind (commands choose a precision) is not what the next one starts with."""
    diffsim_ti.runtime.set_precision("f64")
