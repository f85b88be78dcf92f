"""Host side of perception and grasp planning."""
