"""The commands."""

import os
import sys

# Before numpy is loaded. The loop's matrices are small; with more threads a product in its main thread waits for one
# that is worked on aside, for as long as that thread of no priority takes. What computes beside a loop leaves it the
# other processors, and is quicker itself: an experiment's design takes a third of the processor time.
if sys.argv[1:2] in (["loop"], ["gateway"], ["commission"], ["demo"]):
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
