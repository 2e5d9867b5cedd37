"""Images before they are matched: pyramids, undistortion, quality."""
