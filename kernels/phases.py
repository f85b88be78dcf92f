"""What a world does. Each world carries its own codes, on the device; the host only reads them."""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Phases of an episode.
EMPTY = wp.constant(0)
"""Waits for an episode number."""
START = wp.constant(1)
"""Has an episode number; objects are to be drawn and dropped."""
SETTLE = wp.constant(2)
"""Objects fall and come to rest."""
ACT = wp.constant(3)
"""The gripper acts; every tick is a frame."""
OVER = wp.constant(4)
"""The episode ended this tick; `ending` says how."""
IDLE = wp.constant(5)
"""No episode is left."""

# Modes of an episode: what the gripper does while it acts.
MOVE = wp.constant(0)
"""Stirs the pile."""
PICK = wp.constant(1)
"""Picks the object that lies highest in the clutter graph."""
TARGET = wp.constant(2)
"""Picks the object that lies lowest in it."""

# Tasks of the gripper while a world acts in the modes PICK and TARGET.
NO_TASK = wp.constant(0)
LOOK = wp.constant(1)
"""Waits beside the tote; an object is chosen at the end of the tick."""
APPROACH = wp.constant(2)
"""The goal moves from far above to a short way before the grasp point."""
DESCEND = wp.constant(3)
"""The goal moves along the normal to the grasp point."""
PRESS = wp.constant(4)
"""The goal rests at the grasp point, so that the cup comes to rest; the rays are cast at the end of the tick in which the time is up."""
LIFT = wp.constant(5)
"""The goal moves up; what hangs on the cup is judged at the end of the tick in which it arrives."""

# Codes of synpick_warp.codes.Ending; a test keeps the two in step.
ENDING_RUNNING = wp.constant(0)
ENDING_FINISHED = wp.constant(1)
ENDING_EMPTIED = wp.constant(2)
ENDING_GAVE_UP = wp.constant(3)
ENDING_UNSETTLED = wp.constant(4)
ENDING_ARRANGEMENT_OVERFLOW = wp.constant(5)
ENDING_SOLVER_OVERFLOW = wp.constant(6)
ENDING_NOT_FINITE = wp.constant(7)
ENDING_SIGHT_OVERFLOW = wp.constant(8)

# Codes of synpick_warp.codes.Outcome; the same test.
OUTCOME_NONE = wp.constant(0)
OUTCOME_TARGET_PICKED = wp.constant(1)
OUTCOME_OTHER_PICKED = wp.constant(2)
OUTCOME_DROPPED = wp.constant(3)
OUTCOME_NOTHING_CAUGHT = wp.constant(4)
OUTCOME_NOTHING_SEEN = wp.constant(5)


@wp.func
def delivers(ending: int) -> bool:
    """Whether an episode with this ending becomes part of the data set."""
    return ending >= ENDING_FINISHED and ending <= ENDING_GAVE_UP
