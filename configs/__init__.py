# SPDX-License-Identifier: MIT
"""Experiments that come with the package; `sononerf fit NAME` finds them."""
