# SPDX-License-Identifier: MIT
"""The built-in scenes, registered as everyone's are; the model for a plugin."""
