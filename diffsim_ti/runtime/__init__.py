"""The one door to Taichi's runtime: start-up, precision, arrays that are freed, fields that are lent and returned.

Nothing else in the package touches `taichi.lang.impl` or `taichi._lib`.
"""

from diffsim_ti.runtime.quadrants import QUADRANTS, stand_in

stand_in()

from diffsim_ti.runtime.arrays import (
    allocated_megabytes,
    array,
    clear,
    fetch,
    fetch_row,
    fill,
    full_shape,
    look,
    to_numpy_dtype,
    upload,
    view,
)
from diffsim_ti.runtime.device import device_name, use_device
from diffsim_ti.runtime.field_pool import FieldPool, current_tape, fields
from diffsim_ti.runtime.kernels import LANES, ROWS, Kernel, array_types, kernels_of
from diffsim_ti.runtime.language import Bundle, assign, at, each_lane, let, spread, traced, variable
from diffsim_ti.runtime.launch import Launch, TensorLaunch
from diffsim_ti.runtime.repeated_loops import can_repeat
from diffsim_ti.runtime.start import (
    NUMPY,
    PRECISIONS,
    arch_name,
    available_archs,
    check_alive,
    check_backend,
    check_host_init,
    check_precision,
    init,
    is_alive,
    program,
    runs_on_cpu,
    set_precision,
)
from diffsim_ti.runtime.threads import take_turns as _take_turns

if not QUADRANTS:
    from diffsim_ti.runtime.sources import trace_faster as _trace_faster

    _trace_faster()
_take_turns()
