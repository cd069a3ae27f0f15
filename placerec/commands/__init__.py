# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `placerec`, one to a file, and what those of `run_slam` share with them.

BLAS starts its threads while NumPy is loaded, which comes after this. The matrices of a run are so
small that such threads wait for longer than they work; whoever knows better has said so before.
It holds for all commands: what learns does so by torch, which has threads of its own.
"""

import os

if "OMP_NUM_THREADS" not in os.environ:  # which tells BLAS as well
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
