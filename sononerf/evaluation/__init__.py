# SPDX-License-Identifier: MIT
"""Prediction, metrics, baselines and the true surface."""
