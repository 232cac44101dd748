# SPDX-License-Identifier: MIT
"""What people look at: pictures, projections and mesh files."""
