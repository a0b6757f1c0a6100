"""The model along the axis: ions, neutrals and electrons between anode and cathode plane."""
