# SPDX-License-Identifier: MIT
"""The command line: parse, call one function of `run`, print what was written.

torch, lightning and pyvista are imported inside the commands, so that ``--help`` is quick.
"""
