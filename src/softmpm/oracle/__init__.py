"""The method once more in plain float64 PyTorch, without a kernel: the truth in tests, and the tangents of the step limits."""
