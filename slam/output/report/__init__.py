# SPDX-License-Identifier: Apache-2.0
"""One self-contained web page that shows what every loop decision did to the drift."""
