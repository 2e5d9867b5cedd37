"""How given truth is to be read: conventions of its poses, its clock, and where its body sits."""
