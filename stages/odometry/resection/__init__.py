"""From tracks and landmarks to poses: resection, bundle adjustment, trajectory."""
