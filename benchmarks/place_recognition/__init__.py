# SPDX-License-Identifier: Apache-2.0
"""The results page of `placerec`: what is compared, trained, measured and written down."""
