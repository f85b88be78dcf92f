"""A package of others: a format, a gripper and a layer for synpick-warp."""
