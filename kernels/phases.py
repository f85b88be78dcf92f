"""Phases of a world. Each world carries its own, on the device; the host only reads them."""

import warp as wp

EMPTY = wp.constant(0)
"""Waits for an episode number."""
START = wp.constant(1)
"""Has an episode number; objects are to be drawn and dropped."""
SETTLE = wp.constant(2)
"""Objects fall and come to rest."""
ACT = wp.constant(3)
"""The gripper acts; every tick is a frame."""
OVER = wp.constant(4)
"""The episode ended this tick; `outcome` says how."""
IDLE = wp.constant(5)
"""No episode is left."""

# Codes of synpick_warp.outcome.Outcome that kernels write; a test keeps the two in step.
OUTCOME_RUNNING = wp.constant(0)
OUTCOME_FINISHED = wp.constant(1)
OUTCOME_UNSETTLED = wp.constant(2)
OUTCOME_ARRANGEMENT_OVERFLOW = wp.constant(3)
OUTCOME_SOLVER_OVERFLOW = wp.constant(4)
OUTCOME_NOT_FINITE = wp.constant(5)
