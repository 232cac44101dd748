# SPDX-License-Identifier: MIT
"""Three-dimensional hearing: from the echoes of known poses to a reflectivity field and a mesh.

Shape letters used in docstrings and comments: ``P`` poses, ``D`` directions, ``E`` ears
(left, right), ``F`` frequencies, ``R`` range slices, ``S`` time samples, ``N`` points or
rays, ``B`` batch, ``V`` vertices, ``T`` triangles.
"""

__version__ = "0.1.0"
