"""The Locus method: elevations on a lattice straight from disparities (paper, 4.4)."""
