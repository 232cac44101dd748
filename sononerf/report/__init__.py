# SPDX-License-Identifier: MIT
"""Pictures, projections, reports and mesh files."""
