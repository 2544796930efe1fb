"""The scheme of the reference formulation."""
