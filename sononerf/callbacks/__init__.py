# SPDX-License-Identifier: MIT
"""What happens around the fit: previews, pictures, progress, checkpoints."""
