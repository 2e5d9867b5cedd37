"""Facts of the stages: statements of their results beside arrays, one module for each package of stages."""
