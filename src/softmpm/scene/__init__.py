"""What a person designs: NumPy arrays and plain SI numbers only."""
