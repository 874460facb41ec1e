"""Array types used in the signatures of all packages, and norms and exponentials of many matrices at once."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
RealArray = NDArray[np.floating[Any]]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
_ROUGH = 1e-5
"""Ratio of squared singular values below which the smaller one is known to fewer than ten digits."""


def spectral_norms(matrices: NDArray[Any]) -> FloatArray:
    """Largest singular value of each matrix in a stack (k, m, n), shape (k,).

    It is the root of the largest eigenvalue of M'M, which keeps all its digits and takes a third of the time of a
    decomposition. A single row or column is measured by its length, in a tenth of that time.
    """
    if min(matrices.shape[1:]) == 1:
        return np.sqrt((np.abs(matrices) ** 2).sum(axis=(1, 2)))
    size, squares = _squared_singular_values(matrices)
    return size * np.sqrt(squares[:, -1].clip(min=0.0))


def least_singular_values(matrices: NDArray[Any]) -> FloatArray:
    """Smallest singular value of each square matrix in a stack (k, n, n), shape (k,), to ten digits.

    It is the root of the smallest eigenvalue of M'M, or comes from a decomposition where that has lost too many digits.
    """
    size, squares = _squared_singular_values(matrices)
    found = size * np.sqrt(squares[:, 0].clip(min=0.0))
    rough = squares[:, 0] < _ROUGH * squares[:, -1]
    if rough.any():
        found[rough] = np.linalg.svd(matrices[rough], compute_uv=False)[:, -1]
    return found


def _squared_singular_values(matrices: NDArray[Any]) -> tuple[float, FloatArray]:
    """A size s, and the squared singular values of M / s, rising, of each matrix M in a stack."""
    size = float(2.0 ** (np.frexp(np.abs(matrices).max(initial=0.0))[1] - 1))  # else squares may overflow
    matrices = matrices / size
    adjoint = matrices.conj().swapaxes(1, 2)
    squares = matrices @ adjoint if matrices.shape[1] < matrices.shape[2] else adjoint @ matrices
    return size, np.linalg.eigvalsh(squares).astype(np.float64)


def matrix_exponentials(generator: FloatArray, durations: FloatArray, *, less_one: bool = False) -> FloatArray:
    """e^{X t} (k, n, n) of one matrix X (n, n) for k durations t, by a Taylor polynomial, scaling and squaring.

    `less_one` gives e^{X t} - I, with all its digits however short t is. All durations share the powers of X: SciPy's
    `expm` takes 60 us for each matrix of a stack. The last results are cached: a search needs those of one plant only.
    """
    at_s = np.asarray(durations, np.float64).tobytes()
    return _exponentials(len(generator), np.asarray(generator, np.float64).tobytes(), at_s, less_one)


@lru_cache(maxsize=16)
def _exponentials(size: int, content: bytes, at_s: bytes, less_one: bool) -> FloatArray:
    generator, durations = np.frombuffer(content).reshape(size, size), np.frombuffer(at_s)
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
    result.flags.writeable = False
    return result
