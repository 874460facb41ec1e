"""Norms of many matrices at once."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray


def spectral_norms(matrices: NDArray[Any]) -> FloatArray:
    """Largest singular value of each of matrices (k, m, n), shape (k,).

    That of a single row or column is its length, which takes a tenth of the time of a decomposition.
    """
    if min(matrices.shape[1:]) == 1:
        return np.sqrt((np.abs(matrices) ** 2).sum(axis=(1, 2)))
    return np.linalg.norm(matrices, ord=2, axis=(1, 2)).astype(np.float64)
