"""From images to camera motion: displacements, tracks, key frames, poses, loops."""
