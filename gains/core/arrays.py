"""Array types used in the signatures of all packages, and norms and exponentials of many matrices at once."""

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


def matrix_exponentials(generator: FloatArray, durations: FloatArray, *, less_one: bool = False) -> FloatArray:
    """e^{X t} (k, n, n) of one matrix X (n, n) for k durations t, by a Taylor polynomial, scaling and squaring.

    `less_one` gives e^{X t} - I, with all its digits however short t is. All durations share the powers of X: SciPy's
    `expm` takes 60 us for each matrix of a stack.
    """
    longest = float(durations.max(initial=0.0))
    norm = float(np.abs(generator).sum(axis=-1).max(initial=0.0)) * longest
    squarings = max(0, int(np.ceil(np.log2(norm / 0.5)))) if norm > 0.0 else 0
    scaled, terms = generator * (longest / 2.0**squarings), [np.eye(len(generator))]
    # the first omitted term is 0.5^15 / 15! < 2e-17
    for degree in range(1, 15):
        terms.append(scaled @ terms[-1] / degree)
    shares = durations / longest if longest > 0.0 else durations
    first = 1 if less_one else 0
    result = np.tensordot(np.vander(shares, 15, increasing=True)[:, first:], np.array(terms[first:]), 1)
    for _ in range(squarings):
        result = result @ result + 2.0 * result if less_one else result @ result
    return result
