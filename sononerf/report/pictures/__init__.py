# SPDX-License-Identifier: MIT
"""Pictures: the only place that draws."""
