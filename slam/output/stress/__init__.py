# SPDX-License-Identifier: Apache-2.0
"""How much a recording can be spoilt before the run on it is: trials, table and curves."""
