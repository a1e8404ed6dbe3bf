"""What can a layout know? Grasps are played once, every layout is read from the same ones, and a
classifier says how much the readings tell of the outcome and of the object."""
