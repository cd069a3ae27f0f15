# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

# At the end: what is installed is tested, and only the benchmarks come from the checkout.
sys.path.append(str(Path(__file__).parents[2]))
