"""Array kernels that know nothing of cameras or terrain."""
