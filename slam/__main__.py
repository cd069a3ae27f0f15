# SPDX-License-Identifier: Apache-2.0
"""`python -m slam` is `run_slam`."""

import sys

from slam.cli import main

sys.exit(main())
