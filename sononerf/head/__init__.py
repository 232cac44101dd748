# SPDX-License-Identifier: MIT
"""The head: emitter, receivers, air, call and front end."""
