# SPDX-License-Identifier: Apache-2.0
"""Places looked for by what they look like: of one map, and of many sessions in a database."""
