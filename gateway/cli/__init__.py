"""The commands."""

import os

# Before numpy is loaded, and for every process that a command starts. Matrices are small here; with more threads a
# product in the loop's main thread waits for one that is worked on aside, for as long as that thread of no priority
# takes. What computes beside a loop leaves it the other processors, and is quicker itself: an experiment's design takes
# a third of the processor time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
