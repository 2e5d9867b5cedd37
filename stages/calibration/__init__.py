"""How the two cameras stand and what they are: orientation, rig, lens targets, swapped sides."""
