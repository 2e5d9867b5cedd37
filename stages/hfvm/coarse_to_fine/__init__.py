"""From the top of the pyramid to the finest level, with either solver of a level."""
