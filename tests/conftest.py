"""Set up before any test module is loaded."""

import gcs

assert gcs.__doc__  # importing it keeps BLAS to one thread, which has to happen before numpy is loaded
