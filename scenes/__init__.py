"""Objects, tote, gripper, cameras, lights, and the model built from them."""
