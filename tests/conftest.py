"""Set up before any test module is loaded."""

from hypothesis import settings

import gcs

assert gcs.__doc__  # importing it keeps BLAS to one thread, which has to happen before numpy is loaded

# no test judges a time: on a busy machine an example may take anything
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
