import os

# As the commands are run: on small matrices threads of linear algebra wait on each other. Before anybody has numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
