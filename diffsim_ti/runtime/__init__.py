"""The one door to Taichi's runtime: start-up, precision, arrays that are freed, fields that are lent and returned.

Nothing else in the package imports from `taichi.lang` or `taichi._lib`, or reads private names (tests/test_layout.py).
What is used of Taichi's internals, by which module, and what Quadrants has instead (quadrants.py, DIFFSIM_TI_TAICHI):

| used | by | for | Quadrants |
| --- | --- | --- | --- |
| `impl.get_runtime()`: `prog`, `target_tape`, `grad_replaced`, `materialize` | start, field_pool, threads, launch |
whether Taichi runs, its tape, its program | `_prog` |
| `impl.current_cfg`, `prog.config()` and its options | start, launch | backend, options of one kernel | the same |
| `kernel._primal`, `ensure_compiled`, `compiled_kernels`, `prog.compile_kernel`, `launch_kernel`, launch contexts |
launch | launches with bound arguments | plain calls, which keep their arguments |
| two pointers in a launch context; the launcher's list of compiled functions | launch | launches on CUDA; on a processor,
without the launcher | not used |
| layout of a compiled kernel | repeated_loops | several substeps in a launch on CUDA | not used |
| `Ndarray`, `VectorNdarray`, `ScalarNdarray`, `prog.create_ndarray`, `delete_ndarray`, `fill_uint`,
`get_ndarray_data_ptr_as_int` | arrays | arrays that are freed, NumPy's view of them | its constructors |
| `impl.expr_init`, `impl.subscript`, `Expr`, `_assign`, `_is_taichi_function` | language | functions that build code
while kernels compile | `_is_quadrants_function`; dataclasses handed on whole |
| `kernel_impl._get_tree_and_ctx`, `transform_tree`, `ASTTransformerContext`, `ops.cast`, `core.make_const_expr_fp` |
sources | faster tracing | not used |
| `ASTTransformer.build_Assign`, annotations of a function's parameters | tracer | fewer variables | not used |
| `kernel_impl.Kernel.__call__` | threads | threads take turns | the same |
| `core.with_cuda`, `with_vulkan`, `arch_name` | start, device | which backends there are | the same |
"""

from diffsim_ti.runtime.quadrants import QUADRANTS, stand_in

stand_in()

from diffsim_ti.runtime.arrays import allocated_megabytes, array, clear, fetch, fetch_row, fill, full_shape, look
from diffsim_ti.runtime.arrays import to_numpy_dtype, upload, view
from diffsim_ti.runtime.device import device_name, use_device
from diffsim_ti.runtime.field_pool import FieldPool, current_tape, fields
from diffsim_ti.runtime.kernels import LANES, ROWS, Kernel, Repeated, array_types, as_kernel, kernel, kernels_of
from diffsim_ti.runtime.language import A, Bundle, Expr, assign, at, each_lane, let, spread, traced, variable
from diffsim_ti.runtime.launch import Launch, TensorLaunch
from diffsim_ti.runtime.piecewise import Piecewise
from diffsim_ti.runtime.repeated_loops import can_repeat
from diffsim_ti.runtime.start import NUMPY, PRECISIONS, arch_name, available_archs, check_alive, check_backend
from diffsim_ti.runtime.start import check_host_init, check_precision, init, is_alive, moves_vectors, program
from diffsim_ti.runtime.start import runs_on_cpu, set_precision
from diffsim_ti.runtime.threads import take_turns as _take_turns
from diffsim_ti.runtime.threads import untaped
from diffsim_ti.runtime.language import cross, number_type, vector_type

_take_turns()
