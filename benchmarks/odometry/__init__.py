"""Parts of ``benchmarks/navigation.py``: odometry by Rille, by OpenCV and by COLMAP behind one interface."""
