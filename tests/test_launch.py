"""Prepared launches: the same kernel with the same arrays again and again, other numbers and other tensors each time."""

import _thread
import signal
import threading
import time
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti
import torch

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.materials.linear_elastic import LinearElasticLaw
from diffsim_ti.runtime import repeated_loops
from diffsim_ti.state.corners import clear_from

pytestmark = pytest.mark.backends


@ti.kernel
def add_multiple(
    source: ti.types.ndarray(ti.f32, 1), target: ti.types.ndarray(ti.f32, 1), factor: ti.f32, first: ti.i32
):
    for i in range(source.shape[0]):
        if i >= first:
            target[i] += factor * source[i]


@ti.kernel
def add_both(target: ti.types.ndarray(ti.f32, 1), one: ti.i32, two: ti.i32):
    for i in range(target.shape[0]):
        target[i] += one + two


@ti.kernel
def exchange(tensor: ti.types.ndarray(ti.f32, 1), array: ti.types.ndarray(ti.f32, 1)):
    for i in range(array.shape[0]):
        kept = array[i]
        array[i] = tensor[i]
        tensor[i] = kept


def test_launch_takes_other_numbers_each_time():
    numbers = np.arange(5, dtype=np.float32)
    source, target = runtime.upload(numbers, ti.f32), runtime.upload(np.zeros(5), ti.f32)
    launch, expected = runtime.Launch(add_multiple, source, target), np.zeros(5, np.float32)
    for k in range(20):
        launch(0.5 * k, k % 5)
        expected[k % 5 :] += np.float32(0.5 * k) * numbers[k % 5 :]
    assert np.array_equal(runtime.fetch(target), expected)


def test_a_launch_that_failed_leaves_no_number_behind():
    target = runtime.upload(np.zeros(4), ti.f32)
    launch = runtime.Launch(add_both, target)
    launch(1, 2)
    with pytest.raises((TypeError, ti.TaichiRuntimeTypeError)):
        launch(5, "two")
    launch(1, 2)
    assert runtime.fetch(target).tolist() == [6.0] * 4


def test_two_launches_of_one_kernel_keep_their_own_arrays():
    source, targets = runtime.upload(np.ones(4), ti.f32), [runtime.upload(np.zeros(4), ti.f32) for _ in range(2)]
    launches = [runtime.Launch(add_multiple, source, target) for target in targets]
    for k in range(6):
        launches[k % 2](1.0 + k % 2, 0)
    assert [runtime.fetch(target).tolist() for target in targets] == [[3.0] * 4, [6.0] * 4]


@ti.kernel
def count_in_two_loops(counts: ti.types.ndarray(ti.i32, 1), most: ti.i32):
    for i in range(1):
        for k in range(most):
            counts[i] = (3 * counts[i] + k) & 1023
    for i in range(1):
        for k in range(most):
            counts[i + 1] = (3 * counts[i + 1] + k) & 1023


def test_an_interrupt_ends_no_launch_between_its_loops():
    counts = runtime.upload(np.zeros(2), ti.i32)
    launch = runtime.Launch(count_in_two_loops, counts)
    launch(1)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever ran before in this process
    try:
        with pytest.raises(KeyboardInterrupt):
            threading.Timer(0.02, _thread.interrupt_main).start()
            launch(10_000_000)
            time.sleep(10)
    finally:
        signal.signal(signal.SIGINT, before)
    first, second = runtime.fetch(counts)
    assert first == second != 0


def test_launch_takes_other_tensors_each_time():
    if runtime.arch_name() == "vulkan":
        pytest.skip("Vulkan's memory is none that torch could see")
    array = runtime.upload(np.zeros(3), ti.f32)
    launch, before = runtime.TensorLaunch(exchange, array), [0.0] * 3
    for k in range(5):
        tensor = torch.full((3,), float(k + 1))
        launch(tensor)
        assert tensor.tolist() == before
        before = runtime.fetch(array).tolist()
        assert before == [k + 1.0] * 3


@pytest.mark.parametrize("dtype", [ti.i32, ti.f32, ti.f64, ti.types.vector(3, ti.f32), ti.types.vector(4, ti.f64)])
def test_arrays_hold_what_is_copied_to_them(dtype):
    number = getattr(dtype, "dtype", dtype)
    if runtime.arch_name() == "vulkan" and number == ti.f64:
        pytest.skip("Vulkan has float32 only")
    shape = (4, 5, *getattr(dtype, "get_shape", tuple)())
    numbers = np.arange(np.prod(shape)).reshape(shape).astype(runtime.to_numpy_dtype(number))
    array, kept = runtime.upload(numbers, dtype), slice(0, 3 if len(shape) == 3 else None)
    assert np.array_equal(runtime.fetch(array), numbers[..., kept])
    runtime.fill(array, numbers[:1] + 1)  # a row for all
    assert np.array_equal(runtime.fetch(array), np.broadcast_to(numbers[:1] + 1, shape)[..., kept])
    runtime.fill(array, 0)
    assert not runtime.fetch(array).any()
    if len(shape) == 3:
        runtime.fill(array, numbers[..., :3])
        for row in (2, -1):
            assert np.array_equal(runtime.fetch_row(array, row), numbers[row, :, :3])


# ---- loops that are gone through many times in a launch ----------------------------------------------------------------


@ti.func
def note_turns(data: ti.template(), plan: ti.template()):
    """Two loops that count themselves as those of explicit passes do, and one that comes once, at the end."""
    first, second = plan.first, plan.second
    for i in range(first):
        turn = data.turns[0]
        if i == 0:
            data.turns[1] = turn
        data.sums[i] += turn + plan.more
    for i in range(second):
        turn = data.turns[1]
        if i == 0:
            data.turns[0] = ti.select(turn + 1 < plan.times, turn + 1, 0)
        data.sums[i] += 100 * data.sums[i + first]
    for i in range(first):
        data.sums[i + first] += 1


def expected_sums(sums: np.ndarray, first: int, second: int, more: int, times: int) -> None:
    for turn in range(times):
        sums[:first] += turn + more
        sums[:second] += 100 * sums[first : first + second]
    sums[first : 2 * first] += 1


@pytest.fixture
def repeated():
    """Launches of the kernel, each with arrays of its own, and those arrays."""
    if not runtime.can_repeat():
        pytest.skip(f"loops cannot be repeated on {runtime.arch_name()}, and are not")
    numbers = dict.fromkeys(("first", "second", "more", "times"), "int")
    kernel = runtime.Kernel(
        "note_turns", note_turns, "f64", dict(data=dict(turns="ints", sums="ints")), numbers, loops=2
    )

    def bind():
        data = SimpleNamespace(turns=runtime.upload(np.zeros(2), ti.i32), sums=runtime.upload(np.arange(20), ti.i32))
        return kernel.bind(data=data), data

    return bind


def test_loops_are_gone_through_as_often_as_a_launch_says(repeated):
    (launch, data), sums = repeated(), np.arange(20)
    for k, times in enumerate((1, 3, 2, 3, 1, 600, 2, 600)):  # of which the longest is a list of 1200 loops
        launch(first=8, second=4 + k % 2, more=k, times=times)
        expected_sums(sums, 8, 4 + k % 2, k, times)
        assert runtime.fetch(data.sums).tolist() == sums.tolist()


def test_launches_of_one_kernel_repeat_their_own_number_of_times(repeated):
    bound, sums = [repeated() for _ in range(2)], [np.arange(20) for _ in range(2)]
    for k in range(6):
        for (launch, data), expected, times in zip(bound, sums, (2, 3 + k % 2)):
            launch(first=6, second=3, more=k, times=times)
            expected_sums(expected, 6, 3, k, times)
            assert runtime.fetch(data.sums).tolist() == expected.tolist()


def test_another_build_of_taichi_is_not_taken_for_this_one(repeated, monkeypatch):
    launch, _ = repeated()
    monkeypatch.setattr(repeated_loops, "_TASK", 40)  # as if tasks were of another size
    with pytest.raises(RuntimeError, match="install taichi==1.7.4"):
        launch(first=8, second=4, more=0, times=2)


@ti.func
def larger(x):
    return ti.max(
        x,
        name_that_nothing_has,  # noqa: F821
    )


@ti.kernel
def not_to_be_compiled() -> float:
    y = 2.0
    return y + larger(y)


@pytest.mark.skipif(runtime.QUADRANTS, reason="in words of its own")
def test_errors_in_kernels_say_where():
    """Taichi asks the package where a node stands (runtime/sources.py), through functions and on several lines."""
    with pytest.raises(ti.TaichiNameError) as error:
        not_to_be_compiled()
    called, source, mark, inlined, wrong, wrong_mark = [x for x in str(error.value).splitlines() if x.strip()][:6]
    assert (
        called.endswith(", in not_to_be_compiled:") and inlined.endswith(", in larger:") and "test_launch.py" in called
    )
    assert source.strip() == "return y + larger(y)" and mark == " " * source.index("larger") + "^" * len("larger(y)")
    assert wrong_mark.count("^") == len("name_that_nothing_has")
    number = int(inlined.split("line ")[1].split(",")[0])
    assert wrong == open(__file__).read().splitlines()[number - 1]


@pytest.fixture
def bundles(monkeypatch):
    """What kernels that compile are given, bundle by bundle: (names, those of them that are read)."""
    out, made = [], runtime.Bundle.__init__

    def remembered(self, **parts):
        made(self, **parts)
        self.__dict__["_read"] = set()
        out.append((set(parts), self.__dict__["_read"]))

    def noted(self, name):
        own = object.__getattribute__(self, "__dict__")
        if name in own and "_read" in own:
            own["_read"].add(name)
        return object.__getattribute__(self, name)

    monkeypatch.setattr(runtime.Bundle, "__init__", remembered)
    monkeypatch.setattr(runtime.Bundle, "__getattribute__", noted, raising=False)
    return out


@dataclass(frozen=True)
class OwnLaw(LinearElasticLaw):
    """One that no kernel was compiled for before."""


class Own(ds.LinearElastic):
    def law(self, precision):
        return OwnLaw(precision)


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver])
def test_kernels_of_a_plain_scene_take_no_array_that_they_do_not_read(solver, bundles):
    """Each costs half a microsecond in every launch."""
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2), Own(1e5, 0.3), terms=[ds.Gravity()], precision="f32")
    rollout = ds.Rollout(solver(scene, dt=1e-3), 2, gradients=["initial_velocities"])
    frames = rollout.forward()
    rollout.vjp(frames, np.ones(frames.positions.shape))
    scenes = [(parts, read) for parts, read in bundles if "tets" in parts]
    spare = {"start", "corner_of", "corner", "inverse_mass", "parameters"}  # which some kernels of a kind read
    assert len(scenes) >= 2 and all(parts <= read | spare for parts, read in scenes)


def test_corners_are_cleared_from_a_place_on():
    corner = runtime.array(ti.f32, 9)
    runtime.fill(corner, 1.0)
    clear_from(corner, 4)
    assert runtime.fetch(corner).tolist() == [1] * 4 + [0] * 5
