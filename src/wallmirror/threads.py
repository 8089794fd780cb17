"""One thread for small matrices: two that wait for each other are up to a hundred times slower than one."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import scipy.linalg as sl
from threadpoolctl import ThreadpoolController


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """A context in which BLAS and LAPACK have one thread."""
    with _libraries().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _libraries() -> ThreadpoolController:
    # Once: to look through all libraries that are loaded takes longer than many a small problem. Those of NumPy and SciPy are
    # not loaded before they are needed.
    sl.cholesky(np.eye(1))
    return ThreadpoolController()
