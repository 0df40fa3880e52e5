"""What changes of states and forces become along pieces of a motion, to first order."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Pieces of more intervals are propagated in blocks where there are few of them.
LONG_PIECE, FEW_PIECES = 200, 32


def propagate(
    by_state: Float[ndarray, "pieces intervals state state"],
    forced: Float[ndarray, "pieces intervals columns state"],
    first: Float[ndarray, "pieces columns state"],
) -> Float[ndarray, "pieces m columns state"]:
    """Return z_{j+1} = z_j by_state_j + forced_j, beginning with `first`.

    Long pieces are worked on in blocks side by side, which are joined afterwards.
    """
    pieces, intervals, size = by_state.shape[:3]
    if intervals > LONG_PIECE and pieces < FEW_PIECES:
        return _in_blocks(by_state, forced, first)
    z = np.empty((pieces, intervals + 1, first.shape[1], size))
    z[:, 0] = first
    for j in range(intervals):
        z[:, j + 1] = z[:, j] @ by_state[:, j] + forced[:, j]
    return z


def _in_blocks(by_state: ndarray, forced: ndarray, first: ndarray) -> ndarray:
    pieces, intervals, size = by_state.shape[:3]
    columns, length = first.shape[1], round(intervals**0.5)
    blocks = -(-intervals // length)
    spare = blocks * length - intervals
    still = np.broadcast_to(np.eye(size), (pieces, spare, size, size))
    through = np.concatenate([by_state, still], axis=1).reshape(pieces * blocks, length, size, size)
    push = np.concatenate([forced, np.zeros((pieces, spare, columns, size))], axis=1)
    wide = np.concatenate(
        [np.zeros((pieces * blocks, length, size, size)), push.reshape(-1, length, columns, size)], axis=2
    )
    begin = np.concatenate([np.eye(size), np.zeros((columns, size))])
    own = propagate(through, wide, np.broadcast_to(begin, (pieces * blocks, *begin.shape)))
    own = own.reshape(pieces, blocks, length + 1, size + columns, size)
    starts = np.empty((pieces, blocks, columns, size))
    starts[:, 0] = first
    for k in range(blocks - 1):
        starts[:, k + 1] = starts[:, k] @ own[:, k, -1, :size] + own[:, k, -1, size:]
    z = starts[:, :, None] @ own[:, :, :, :size] + own[:, :, :, size:]
    inner = z[:, :, :-1].reshape(pieces, blocks * length, columns, size)
    return np.asarray(np.concatenate([inner, z[:, -1:, -1]], axis=1)[:, : intervals + 1])
