"""One BLAS thread while a solver works.

Vectors are short and matrices sparse or slender: threads that BLAS starts for a dot product wait for each other, and took a
half to three quarters of the time of a static solve at 25 000 tetrahedra on two cores.
"""

from collections.abc import Callable
from functools import lru_cache, wraps

from threadpoolctl import ThreadpoolController


@lru_cache(maxsize=1)
def _libraries() -> list:
    """Finding them takes milliseconds; limiting them afterwards does not. Only those that are loaded are found, and scipy
    brings a BLAS of its own."""
    import scipy.linalg  # noqa: F401

    return ThreadpoolController().select(user_api="blas").lib_controllers


def one_blas_thread(function: Callable) -> Callable:
    """The function with BLAS limited to one thread while it runs, and as it was before afterwards, whatever happens."""

    @wraps(function)
    def limited(*arguments, **named):
        several = [(library, n) for library in _libraries() if (n := library.get_num_threads()) not in (None, 1)]
        try:
            for library, _ in several:
                library.set_num_threads(1)
            return function(*arguments, **named)
        finally:
            for library, count in several:
                library.set_num_threads(count)

    return limited
