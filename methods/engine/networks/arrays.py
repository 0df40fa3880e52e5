"""Array operations that run alike on NumPy arrays (the processor) and on torch tensors (another device).

A formula that is written with `Arrays.xp` and the operations below serves both. On torch every array may have one more
axis in front: of members, several networks that are computed together.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from numpy import ndarray

    # A NumPy array on the processor, a torch tensor elsewhere.
    Array = Any


def check_device(device: str) -> None:
    """Make sure that this is the name of a device; whether the machine has it is known where it is used.

    Raises:
        InputError: it is not.
    """
    if not re.fullmatch(r"(cpu|cuda|mps|xpu|hpu)(:\d{1,3})?", device):
        raise InputError(f"device {device!r}: there is no such device; use cpu, or a name of torch's such as cuda:1")


class Arrays:
    """The array package of a device, and what NumPy and torch do not have under one name.

    Attributes:
        device: `cpu` for NumPy, or a device of torch's, such as `cuda`; `cpu:0` is torch on the processor.
        xp: numpy or torch.
        move: function that turns a NumPy array of numbers into a float64 array of `xp` on the device.
    """

    def __init__(self, device: str) -> None:
        """Find the device.

        Raises:
            InputError: there is no such device, or it cannot compute in double precision.
        """
        self.device = device
        self.xp: Any
        self.move: Callable[[Any], Array]
        if device == "cpu":
            self.xp, self.move = np, lambda array: np.ascontiguousarray(array, dtype=float)
            return
        import torch

        try:
            torch.zeros(1, dtype=torch.float64, device=device).cpu()
        except (RuntimeError, AssertionError, TypeError) as error:
            reason = str(error).strip().splitlines()[0]
            message = f"device {device!r}: torch cannot use it in double precision ({reason}); use cpu"
            raise InputError(message) from None
        self.xp = torch
        self.move = lambda array: torch.tensor(np.ascontiguousarray(array), dtype=torch.float64, device=device)

    @property
    def batches(self) -> bool:
        """Whether members are computed together, along one more axis in front: on torch, not on NumPy."""
        return self.xp is not np

    def index(self, numbers: ndarray) -> Array:
        """Move whole numbers or truth values to the device."""
        return self.xp.tensor(numbers, device=self.device) if self.batches else numbers

    def zeros(self, *shape: int) -> Array:
        """Return an array of zeros."""
        return self.xp.zeros(shape, dtype=self.xp.float64, device=self.device) if self.batches else np.zeros(shape)

    def cholesky(self, matrix: Array) -> tuple[Array, Array]:
        """Factorise symmetric matrices (..., n, n), which may be overwritten.

        Returns:
            the factors (..., n, n), of which only the lower triangle means anything, and a truth value (...) for each:
            whether its matrix was positive definite. The factor of one that was not is the identity.
        """
        if not self.batches:
            from scipy.linalg import cho_factor

            try:
                return cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)[0], np.True_
            except np.linalg.LinAlgError:
                return np.eye(len(matrix)), np.False_
        factor, failed = self.xp.linalg.cholesky_ex(matrix)
        factor[failed > 0] = self.xp.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        return factor, failed == 0

    def solve(self, factor: Array, right: Array) -> Array:
        """Solve the factorised equations for right-hand sides (..., n, m)."""
        if not self.batches:
            from scipy.linalg import cho_solve

            return cho_solve((factor, True), right, check_finite=False)
        return self.xp.cholesky_solve(right, factor)

    def inverse(self, factor: Array) -> Array:
        """Return the inverse (..., n, n) of the lower triangle of each factor, not of the factorised matrix."""
        if not self.batches:
            from scipy.linalg import solve_triangular

            return solve_triangular(factor, np.eye(len(factor)), lower=True, overwrite_b=True, check_finite=False)
        one = self.xp.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        return self.xp.linalg.solve_triangular(factor, one.expand_as(factor), upper=False)


def host(array: Array) -> ndarray:
    """Return an array, or a number, of any device as a NumPy array."""
    return np.asarray(array.cpu() if hasattr(array, "cpu") else array)


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep the linear algebra in one thread, the fastest at these sizes and the same digits each time."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        yield
