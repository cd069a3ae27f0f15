# SPDX-License-Identifier: Apache-2.0
"""The loop ledger, loops.jsonl: every loop decision with its numbers, one JSON object per line."""
