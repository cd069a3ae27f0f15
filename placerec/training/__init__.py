# SPDX-License-Identifier: Apache-2.0
"""The paper's training: sets of images, losses, and a loop that can be stopped and gone on with."""
