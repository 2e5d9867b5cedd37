"""Commands on a sequence, or on images, before a reconstruction."""
