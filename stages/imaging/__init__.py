"""Images before matching: pyramids, undistortion, quality."""
