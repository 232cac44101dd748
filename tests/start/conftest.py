# SPDX-License-Identifier: MIT
from tests.refinement.conftest import one_thread

__all__ = ["one_thread"]
