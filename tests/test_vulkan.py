"""The tests marked `backends`, run on Vulkan: the same kernels on a device whose memory is not the host's."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from diffsim_ti import runtime

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(
    bool({"DIFFSIM_TI_ARCH", "DIFFSIM_TI_FORM"} & set(os.environ)), reason="this is a run of another backend or form"
)
def test_marked_tests_pass_on_vulkan():
    available = runtime.available_archs()
    if "vulkan" not in available:
        pytest.skip(f"no Vulkan driver here (available: {', '.join(available)}); mesa's lavapipe is one in software")
    command = [sys.executable, "-m", "pytest", "tests", "-m", "backends", "-q", "--tb=short", "-p", "no:cacheprovider"]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"DIFFSIM_TI_ARCH": "vulkan"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert int(re.search(r"(\d+) passed", done.stdout).group(1)) >= 10
