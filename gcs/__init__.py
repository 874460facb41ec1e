"""The ground station: flies formations over MAVLink and compares measured loop delay with the delay margin."""

import os

# Before numpy is loaded: the matrices are small, and several BLAS threads on shared cores made them ten times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
