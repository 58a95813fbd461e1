"""One Taichi runtime for the whole session; DIFFSIM_TI_ARCH names another backend (cuda_on_cpu uses it).

DIFFSIM_TI_FORM=gpu: arrays, kernels and launches take the form for a GPU, on the CPU.
DIFFSIM_TI_DEBUG=1: kernels check the bounds of every array; slow, in one process: `DIFFSIM_TI_DEBUG=1 python -m pytest`.
"""

import gc
import os

import areas
import pytest
from left_out import left_out

import diffsim_ti

ARCH = os.environ.get("DIFFSIM_TI_ARCH", "cpu")
PLAIN = not {"DIFFSIM_TI_ARCH", "DIFFSIM_TI_FORM", "DIFFSIM_TI_TAICHI"} & os.environ.keys()


_spent = {}  # seconds of processors until a test began


def pytest_collection_finish():
    _spent["until"] = sum(os.times()[:4])


def start():
    debug = dict(debug=True) if os.environ.get("DIFFSIM_TI_DEBUG") else {}
    diffsim_ti.init(ARCH, precision="f64", **debug)


@pytest.fixture(scope="session", autouse=True)
def taichi():
    start()
    gc.freeze()  # all modules: tracing kernels makes many objects, and each thousand of them would look through these
    gc.set_threshold(20_000, 20, 20)  # looks a thirtieth as often: they take a twentieth of the time


@pytest.fixture(scope="module", autouse=True)
def as_at_first(taichi):
    """What a file leaves behind (commands choose a backend and a precision) is not what the next one starts with."""
    if diffsim_ti.runtime.arch_name() != ARCH:
        start()
    diffsim_ti.runtime.set_precision("f64")


def pytest_addoption(parser):
    parser.addoption(
        "--minutes", action="store_true", help="write the processors' minutes of each area to tests/README.md"
    )
    parser.addoption("--thorough", action="store_true", help="also tests whose behaviour a cheaper one proves, too")


def pytest_configure(config):
    config.option.loadscopereorder = False  # pytest-xdist would put files of few tests last, however long they are


def pytest_collection_modifyitems(config, items):
    """Without the thorough ones; for several processes in the order of areas.py."""
    if not config.getoption("--thorough"):
        single = left_out(PLAIN)
        whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
        if whole and not config.getoption("lf", False):
            if gone := single - {_id(item) for item in items}:
                raise pytest.UsageError(f"left_out.py names tests that are not there: {', '.join(sorted(gone))}")
        deselected = {item for item in items if item.get_closest_marker("thorough") or _id(item) in single}
        config.hook.pytest_deselected(items=list(deselected))
        items[:] = [item for item in items if item not in deselected]
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: areas.place(item.path))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """With --minutes durations are those of processors, of processes that a test starts, too, whatever else runs."""
    report = yield
    if item.config.getoption("--minutes"):
        begin, _spent["until"] = _spent["until"], sum(os.times()[:4])
        report.duration = _spent["until"] - begin
    return report


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With `--dist loadfile` a process takes whole files, every other one from the end: those that have scenes in common are
    neighbours."""
    if config.getoption("dist") == "loadfile":
        from xdist.scheduler import LoadFileScheduling

        class FromBothEnds(LoadFileScheduling):
            def _assign_work_unit(self, node):
                early = [scope for scope in self.workqueue if areas.place(scope) < len(areas.ORDER)]
                if self.nodes.index(node) % 2 and early:
                    self.workqueue.move_to_end(early[-1], last=False)
                super()._assign_work_unit(node)

        return FromBothEnds(config, log)


def _id(item) -> str:
    """As left_out.py names it."""
    return item.nodeid.removeprefix("tests/").replace(".py", "", 1)


def pytest_terminal_summary(terminalreporter, config):
    if config.getoption("--minutes"):
        reports = [r for kind in terminalreporter.stats.values() for r in kind if isinstance(r, pytest.TestReport)]
        minutes = areas.minutes_of(reports)
        areas.write(minutes)
        terminalreporter.write_line("minutes: " + ", ".join(f"{area} {spent:.1f}" for area, spent in minutes.items()))
    if earlier := os.environ.get("OTHER_FORMS"):  # what calls of pytest on other backends came to, from .ci/run
        terminalreporter.write_line(earlier.rstrip())


@pytest.fixture
def vertices_alone(monkeypatch):
    """Scenes in which obstacles act on vertices alone, as for points that happen to have faces between them."""
    monkeypatch.setattr("diffsim_ti.terms.obstacles.obstacle.longest_edge", lambda mesh: 0.0)
