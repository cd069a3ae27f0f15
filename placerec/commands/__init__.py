# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `placerec`, one to a file."""
