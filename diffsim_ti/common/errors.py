"""Errors that several folders raise."""

from collections.abc import Iterable

from diffsim_ti.common.copies import CarriesMore


class NotConverged(CarriesMore, FloatingPointError):
    """An iteration did not reach its tolerance. Carries `residuals`, the relative residual after each round."""

    def __init__(self, message: str, residuals: Iterable[float]):
        super().__init__(message)
        self.residuals = list(residuals)
