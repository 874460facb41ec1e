"""Tests, in the same rooms as the code; `support` is what they share."""

import gcs

assert gcs.__doc__  # importing it keeps BLAS to one thread, which has to happen before numpy is loaded
