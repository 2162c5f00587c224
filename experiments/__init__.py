"""The only place with Hydra and MLflow: compose, build, run, log, collect.

Importing it caps the threads of the numerical libraries at one, unless the user has set them:
parallelism is over runs, and results do not depend on the number of cores. Garbage is collected
seldom, and not at exit: going through the many objects of the imports takes a fifth of a short run.
"""

import atexit
import gc
import os

from mvest.provenance import THREAD_VARIABLES

gc.set_threshold(50_000)
atexit.register(gc.freeze)

for _name in THREAD_VARIABLES:
    os.environ.setdefault(_name, "1")
