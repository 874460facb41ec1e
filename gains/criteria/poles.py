"""The region of the roots of a loop without delay: their least damping ratio and their largest natural frequency.

With delay a loop has infinitely many roots, with ratios down to zero far to the left, so a region of all of them means
nothing; of these the rightmost one counts (`gains.performance.behaviour`).
"""

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.core.structure import distinct_blocks


def roots_of(A: FloatArray) -> ComplexArray:
    """Return the eigenvalues of A (n, n), those of equal strongly connected blocks once.

    Taken as a whole, equal followers would spoil each other's eigenvalues.

    >>> roots_of(np.diag([-1.0, -1.0, -2.0])).real.tolist()
    [-1.0, -2.0]
    """
    blocks = distinct_blocks(A)
    return np.concatenate([np.linalg.eigvals(block.matrices[0]) for block in blocks]).astype(np.complex128)


def pole_region(roots: ComplexArray) -> tuple[float, float]:
    """Return the least damping ratio −Re s / |s| and the largest |s| (rad/s) of roots (k,). A root at zero has ratio 0.

    s² + s + 1 has roots of magnitude 1 and ratio 1/2:

    >>> [round(value, 9) for value in pole_region(roots_of(np.array([[0.0, 1.0], [-1.0, -1.0]])))]
    [0.5, 1.0]
    """
    size = np.abs(roots)
    ratios = np.where(size > 0.0, -roots.real / np.where(size > 0.0, size, 1.0), 0.0)
    return float(ratios.min()), float(size.max())
