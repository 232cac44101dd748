# SPDX-License-Identifier: MIT
"""Echoes that lie in memory alone."""

from __future__ import annotations

import numpy as np

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.memory_ensemble import SPLITS


class MemoryStore:
    """The reading side of a store.

    Parameters
    ----------
    positions, rotations
        (P, 3) m and (P, 3, 3).
    read : callable
        From a pose's number to its magnitude (E, R, F).
    split : (P,) int, optional
        0 train, 1 validation, 2 test; the last three poses validate where None.
    head : Head, optional
        Whose axes it has.
    """

    def __init__(self, positions, rotations, read, split=None, head=None, **attributes):
        count = len(positions)
        self.positions, self.rotations = np.asarray(positions), np.asarray(rotations)
        self.split = np.where(np.arange(count) < count - 3, 0, 1) if split is None else split
        self.read_pose = read
        self.attributes = {"origin": "simulated", "reference": 1.0, **attributes}
        if head is not None:
            self.range, self.frequency = head.range, head.frequency

    def __len__(self):
        return len(self.positions)

    def indices(self, split):
        """Return the numbers of a split's poses."""
        return np.flatnonzero(np.asarray(self.split) == SPLITS[split])


def echoes_of(head, positions, rotations, read, split=None, hull=None, **attributes):
    """Return echoes in memory."""
    store = MemoryStore(positions, rotations, read, split, head, **attributes)
    return Echoes(store, head, hull)


def changed(echoes, *, read=None, positions=None, split=None, hull=None, **attributes):
    """Return the same echoes with other parts; free space is found anew where none is given."""
    old = echoes.store
    return echoes_of(
        echoes.head,
        old.positions if positions is None else positions,
        old.rotations,
        read or old.read_pose,
        old.split if split is None else split,
        hull,
        **{**old.attributes, **attributes},
    )


def deaf_hull():
    """Return the free space of one pose that heard nothing."""
    return EchoHull(
        emitters=np.zeros((1, 3)),
        receivers=np.zeros((1, 1, 3)),
        first=np.full((1, 1), -np.inf),
        axes=np.array([[1.0, 0.0, 0.0]]),
        within=0.5,
    )
