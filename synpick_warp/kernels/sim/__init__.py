"""Device code of the simulation: arrangements, settling, the gripper's tasks and control, the suction cup."""
