"""Photos and masks: reading, undistortion, reduction in bands."""
