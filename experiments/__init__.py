"""The only place with Hydra and MLflow: compose, build, run, log, collect.

Importing it caps the threads of the numerical libraries before any of them is loaded, unless the
user has set them: parallelism is over runs, and results do not depend on the machine's cores. It
also has garbage looked for seldom, and not at all in a process that ends: the many objects that
imports make stay to the end, and looking through them takes a fifth of a short run.
"""

import atexit
import gc
import os

from mvest.provenance import THREAD_VARIABLES

gc.set_threshold(50_000)
atexit.register(gc.freeze)

for _name in THREAD_VARIABLES:
    os.environ.setdefault(_name, "1")
