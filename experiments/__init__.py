"""The only place with Hydra and MLflow: compose, build, run, log, collect.

Importing it caps the threads of the numerical libraries before any of them is loaded, unless the
user has set them: parallelism is over runs, and results do not depend on the machine's cores.
"""

import os

from mvest.provenance import THREAD_VARIABLES

for _name in THREAD_VARIABLES:
    os.environ.setdefault(_name, "1")
