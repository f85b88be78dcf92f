"""Device code of perception and grasp planning: segmentation, contours, suction points, clutter graph, grasps."""
