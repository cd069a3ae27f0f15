# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `run_slam`, and `drift_report`; one to a file."""
