"""The design of a robot and its surroundings: NumPy arrays and SI numbers only."""
