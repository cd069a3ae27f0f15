# SPDX-License-Identifier: Apache-2.0
"""The methods that the paper compares with, each a recognizer of its own."""
