"""Device code of perception and grasp planning: segmentation, contours, grasp points, occlusion votes, clutter graph, grasp poses."""
