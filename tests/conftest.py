"""For all tests: what is about the wall clock says so by its mark, and no property fails because it took long."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the commands: on small matrices threads wait on each other

from hypothesis import HealthCheck, settings

settings.register_profile(
    "any machine", deadline=None, derandomize=False, max_examples=100, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("landing", settings.get_profile("any machine"), derandomize=True, database=None)
settings.load_profile("any machine")
