"""One thread for numerical libraries: faster on small matrices, and the same digits for everybody."""

from __future__ import annotations

import os

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)


def prefer_one_thread() -> None:
    """Let libraries that are loaded later use one thread, unless the environment asks for another number."""
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
