# SPDX-License-Identifier: Apache-2.0
"""`python -m placerec` is `placerec`."""

import sys

from placerec.cli import main

sys.exit(main())
