"""The built-in simulator of the paper's experiment: a rover's stereo cameras over a lunar bed at 1:10."""
