"""Set up before any test module is loaded."""

from hypothesis import settings

# no test judges a time: on a busy machine an example may take anything
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
