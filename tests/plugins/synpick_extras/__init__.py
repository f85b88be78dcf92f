"""A package of others: a format and a gripper for synpick-warp."""
