# SPDX-License-Identifier: MIT
"""The only place that turns settings into objects: simulate, fit, predict, reconstruct, evaluate.

Each command of the command line is one function of this package, for notebooks and scripts too.
"""
