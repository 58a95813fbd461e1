"""One Taichi runtime for the whole session."""

import pytest
import taichi as ti


@pytest.fixture(scope="session", autouse=True)
def taichi():
    ti.init(arch=ti.cpu, default_fp=ti.f64, fast_math=False, offline_cache=True, log_level=ti.ERROR)
