"""Cell: cameras, bins, gripper and sensors, and what follows from their settings alone."""
