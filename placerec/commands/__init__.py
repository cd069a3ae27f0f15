# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `placerec`, one to a file, and what those of `run_slam` share with them.

BLAS starts its threads while NumPy is loaded, which comes after this. The matrices of a run are so
small that such threads wait for longer than they work; whoever knows better has said so before.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
