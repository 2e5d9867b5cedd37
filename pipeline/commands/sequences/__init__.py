"""Commands that look at a sequence, or at pictures, before anything is reconstructed."""
