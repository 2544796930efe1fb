"""The learning phase: what was simulated is stored, an autoencoder is trained on it, and the policy's encoder follows."""
