"""Hierarchical feature vector matching: dense two-dimensional disparities of any two images (paper, 4.3)."""
