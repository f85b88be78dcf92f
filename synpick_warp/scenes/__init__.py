"""Assets of a scene: objects, tote, gripper, cameras, environment maps; and the simulation model built from them."""
