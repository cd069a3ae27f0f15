# SPDX-License-Identifier: Apache-2.0
"""A second, different estimator of which loops are true, and what there is to doubt."""
