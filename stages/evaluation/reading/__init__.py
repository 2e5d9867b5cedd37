"""How given truth is to be read: conventions of its poses and disparities, its clock, and where its body sits."""
