"""Episodes: objects and fills, tasks of the gripper, domain randomization."""
