"""How to read given truth: conventions of its poses, offset of its clock, mounting of its body."""
