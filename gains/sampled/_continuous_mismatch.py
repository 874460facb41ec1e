"""The mismatches at which the continuous predicted loop has a root on the imaginary axis."""

from math import pi

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.delay._loci import delay_loci, swept_crossings, unit_gain_roots
from gains.sampled._loop import HeldPlant

# rotation (rad) of a delayed term between neighbouring frequencies, and the least number of frequencies
_TURN, _LEAST = 0.1, 200
# frequencies added to an even grid: fractions of the highest, and offsets from a pole in half-widths of its resonance
_LOW, _BESIDE_POLE = np.logspace(-5.0, 0.0, 80), np.sinh(np.linspace(-4.0, 4.0, 17))


def highest_crossing(plant: HeldPlant, assumed_s: float) -> float:
    """Bound (rad/s) on the frequencies of `continuous_crossings`; 0 if there are no crossings."""
    loop, carried = plant.A + plant.B @ plant.K, plant.K @ plant.carry(np.array([assumed_s]))[0]
    gain, scale = unit_gain_roots(loop, plant.B, 2.0 * carried), float(np.linalg.norm(loop))
    return 1.05 * float(gain.imag[np.abs(gain.real) <= 1e-6 * scale].max(initial=0.0))


def continuous_crossings(plant: HeldPlant, assumed_s: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies (rad/s) and mismatches (s) at which the continuous loop has a root on the imaginary axis.

    With M(s) = K e^{A tau^} (s I - A - B K)^{-1} B and an eigenvalue lambda of it, e^{s tau} is
    lambda / (1 + lambda e^{-s tau^}). Each crossing yields the nearest mismatch on either side of zero. There is none
    where no singular value of M exceeds a half.
    """
    highest = highest_crossing(plant, assumed_s)
    if highest <= 0.0:
        return np.zeros(0), np.zeros(0)
    loop = plant.A + plant.B @ plant.K
    own = delay_loci(loop, plant.B, plant.K @ plant.carry(np.array([assumed_s]))[0])

    def loci(omega: FloatArray) -> ComplexArray:
        late = own(omega)
        with np.errstate(divide="ignore", invalid="ignore"):  # infinite where a root needs no delay
            return late / (1.0 + late * np.exp(-1j * omega * assumed_s)[:, np.newaxis])

    poles = np.linalg.eigvals(loop).astype(np.complex128)
    resonant = poles.imag[:, np.newaxis] + np.outer(poles.real, _BESIDE_POLE)
    dense = np.linspace(0.0, highest, int(highest * assumed_s / _TURN) + _LEAST)
    omega = np.unique(np.concatenate([dense, highest * _LOW, resonant.ravel()]))
    found = swept_crossings(loci, omega[(omega > 0.0) & (omega <= highest)])
    frequency = np.array([crossing.omega for crossing in found])
    turn_s = 2.0 * pi / frequency
    longer_s = (np.array([crossing.delay_s for crossing in found]) - assumed_s) % turn_s
    return np.tile(frequency, 2), np.concatenate([longer_s, longer_s - turn_s])
