"""The finest level: sub-pixel refinement, standard deviations, filling."""
