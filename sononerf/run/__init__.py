# SPDX-License-Identifier: MIT
"""The only place that writes runs and stores: locks, saves, resumes, and skips finished stages."""
