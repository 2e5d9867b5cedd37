"""From images to camera motion: interest points, tracks, key frames."""
